"""Published yarns: Zhao, Luan and Bala 2016, table 2, fitted to scans of real ones.

The table lists neither the plies nor the fibers' radii. The number of plies is that at which neighbors touch,
``sin(π/K) = e_X / R_ply``, from 2 to 4. The radii are usual ones of the material: cotton 8.5 µm, rayon 7.5,
silk 6, polyester 9.

Table 3 has the widths of the lobes in another scattering model. The roughnesses here give the transmitted
lobe of ours the same widths along and around the fiber: cotton 27 and 38 degrees, rayon 10 and 26, silk and
polyester 10 and 20.
"""

from __future__ import annotations

from typing import Literal

from mbtf_gen.tile.fibers.yarn import YarnModel

YarnName = Literal[
    "cotton1", "cotton2", "rayon1", "rayon2", "rayon3", "rayon4", "silk1", "silk2", "polyester1"
]

_COTTON, _RAYON, _SILK, _POLYESTER = 8.5e-4, 7.5e-4, 6e-4, 9e-4

# Longitudinal and azimuthal roughness of each material.
ROUGHNESS: dict[str, tuple[float, float]] = {
    "cotton": (0.72, 0.60),
    "rayon": (0.35, 0.48),
    "silk": (0.35, 0.41),
    "polyester": (0.35, 0.41),
}

YARNS: dict[YarnName, YarnModel] = {
    "cotton1": YarnModel(
        plies=4, fibers=75, fiber_radius=_COTTON, beta=0.148, epsilon=0.0, pitch=-0.369, ply_pitch=0.453,
        migration=0.80, swing=1.1, long_axis=0.026, short_axis=0.020, ply_distance=0.038,
        loops=22.17, hairs=33.77, loop_reach=(0.024, 0.005), hair_start=(0.020, 0.006),
        hair_rise=(0.016, 0.009), hair_length=(-0.003, 0.057), hair_turn=(0.377, 0.326),
    ),
    "cotton2": YarnModel(
        plies=4, fibers=37, fiber_radius=_COTTON, beta=0.430, epsilon=0.033, pitch=-0.436, ply_pitch=0.336,
        migration=0.95, swing=1.9, long_axis=0.025, short_axis=0.018, ply_distance=0.033,
        loops=13.34, hairs=19.50, loop_reach=(0.026, 0.007), hair_start=(0.021, 0.005),
        hair_rise=(0.014, 0.006), hair_length=(0.019, 0.048), hair_turn=(0.480, 0.404),
    ),
    "rayon1": YarnModel(
        plies=2, fibers=150, fiber_radius=_RAYON, beta=0.682, epsilon=0.139, pitch=0.710, ply_pitch=-0.639,
        migration=0.85, swing=1.9, long_axis=0.053, short_axis=0.036, ply_distance=0.051,
        loops=62.40, hairs=52.52, loop_reach=(0.050, 0.009), hair_start=(0.041, 0.007),
        hair_rise=(0.020, 0.018), hair_length=(0.016, 0.059), hair_turn=(0.403, 0.437),
    ),
    "rayon2": YarnModel(
        plies=2, fibers=80, fiber_radius=_RAYON, beta=0.293, epsilon=0.052, pitch=-0.381, ply_pitch=0.372,
        migration=0.85, swing=1.6, long_axis=0.028, short_axis=0.021, ply_distance=0.029,
        loops=39.08, hairs=50.39, loop_reach=(0.026, 0.006), hair_start=(0.018, 0.005),
        hair_rise=(0.012, 0.007), hair_length=(0.001, 0.025), hair_turn=(0.439, 0.498),
    ),
    "rayon3": YarnModel(
        plies=2, fibers=143, fiber_radius=_RAYON, beta=0.640, epsilon=0.0, pitch=0.609, ply_pitch=-0.638,
        migration=0.95, swing=1.9, long_axis=0.044, short_axis=0.034, ply_distance=0.042,
        loops=44.51, hairs=53.72, loop_reach=(0.041, 0.015), hair_start=(0.030, 0.005),
        hair_rise=(0.028, 0.017), hair_length=(-0.014, 0.110), hair_turn=(0.821, 0.707),
    ),
    "rayon4": YarnModel(
        plies=2, fibers=122, fiber_radius=_RAYON, beta=0.671, epsilon=0.361, pitch=0.560, ply_pitch=-0.498,
        migration=0.70, swing=1.7, long_axis=0.048, short_axis=0.034, ply_distance=0.045,
        loops=59.40, hairs=65.23, loop_reach=(0.043, 0.008), hair_start=(0.038, 0.007),
        hair_rise=(0.021, 0.016), hair_length=(0.009, 0.048), hair_turn=(0.326, 0.287),
    ),
    "silk1": YarnModel(
        plies=4, fibers=33, fiber_radius=_SILK, beta=0.462, epsilon=0.0, pitch=-0.458, ply_pitch=0.526,
        migration=0.95, swing=1.8, long_axis=0.025, short_axis=0.022, ply_distance=0.038,
        loops=20.32, hairs=23.82, loop_reach=(0.024, 0.004), hair_start=(0.021, 0.004),
        hair_rise=(0.014, 0.011), hair_length=(0.010, 0.050), hair_turn=(0.407, 0.390),
    ),
    "silk2": YarnModel(
        plies=4, fibers=47, fiber_radius=_SILK, beta=0.554, epsilon=0.405, pitch=-0.556, ply_pitch=0.702,
        migration=0.70, swing=1.2, long_axis=0.031, short_axis=0.025, ply_distance=0.045,
        loops=18.89, hairs=23.09, loop_reach=(0.029, 0.004), hair_start=(0.024, 0.005),
        hair_rise=(0.010, 0.008), hair_length=(0.008, 0.038), hair_turn=(0.417, 0.446),
    ),
    "polyester1": YarnModel(
        plies=2, fibers=60, fiber_radius=_POLYESTER, beta=0.258, epsilon=0.202, pitch=-0.379, ply_pitch=0.370,
        migration=0.75, swing=1.5, long_axis=0.029, short_axis=0.021, ply_distance=0.029,
        loops=35.69, hairs=30.44, loop_reach=(0.027, 0.004), hair_start=(0.021, 0.005),
        hair_rise=(0.011, 0.009), hair_length=(-0.003, 0.036), hair_turn=(0.356, 0.400),
    ),
}  # fmt: skip


def roughness_of(name: YarnName) -> tuple[float, float]:
    """Longitudinal and azimuthal roughness of a yarn's fibers."""
    return ROUGHNESS[name.rstrip("0123456789")]

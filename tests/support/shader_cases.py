"""Materials of random weights that need all that a shader may have to evaluate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from mbtf_core.data.lattice import Lattice
from mbtf_fit.material.material import Material
from mbtf_fit.material.transmittance import Transmittance

from .plugin_materials import net, write_material

BANDS = {"position": 3, "direction": 2, "direction_pi": False, "raw": True}
CASES: dict[str, dict[str, Any]] = {
    "neumip-baseline": {"model": "neumip-baseline"},
    "calibrated": {},
    "holes": {},
    "direct offset, six outputs": net(offset="direct", output_channels=6, activation="leaky-relu"),
    "concatenated, softplus": net(blending="concatenate", activation="sine", output_transform="softplus"),
    "encoded": net(encoding={**BANDS, "band_attenuation": True, "footprint_filtered": True}),
    "fourth root": net(output_transform="fourth-root", encoding={"direction_xyz": True, "half_vector": True}),
    "relief": {"model": "relief"},
    "relief, two places": {"model": "relief", **net(relief={"places": 2})},
    "relief, diffuse, four places": {"model": "relief", "glossy": False, **net(relief={"places": 4})},
    "relief without hints": {"model": "relief", **net(relief={"hints": False}, oversampling=1)},
    "relief without gate": {
        "model": "relief",
        **net(relief={"gate": False, "frame": False}, output_channels=6),
    },
    "learned heights": {"model": "neumip+"},
    "black": {"model": "relief", "weights": {"unit": torch.zeros(())}},
    "rainer2019": {"model": "rainer2019"},
}


def make(case: str, folder: Path) -> Material:
    """A material of random weights on a tile that is half as high as wide."""
    lattice, generator = Lattice(4, 0.5), torch.Generator().manual_seed(0)
    options = {"finest": 4, "aspect": 0.5, **CASES[case]}
    if case == "calibrated":
        options["weights"] = {"calibration": 0.7 + 0.6 * torch.rand((2, 5, 6, 3), generator=generator)}
    if case == "holes":
        shapes = [(*lattice.shape(s), 6) for s in range(5)]
        coefficients = [0.3 + 0.2 * torch.randn(s, generator=generator).numpy() for s in shapes]
        options["transmittance"] = Transmittance(lattice, coefficients)
    return write_material(folder, **options)

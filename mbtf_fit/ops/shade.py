r"""Shading by what is known of a surface: filtered maps, horizons, reflectance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbtf_fit.ops.constants import (
    ALPHA2,
    LEAST_LIGHT,
    LEAST_VARIANCE,
    LEAST_VIEW,
    LIGHT_BLUR,
    LIGHT_DEPTH,
)
from mbtf_fit.ops.operation import Operation, TensorName, TextureName, Value


@dataclass(frozen=True)
class Shade(Operation):
    r"""Hints of the known surface (6): irradiance e, normal (x, y) and core (RGB), means over intersections.

    Maps and horizons are read at the level ``l + finer``. Maps hold, of the slopes below the footprint, the
    center c (2) and the moments q (xx, xy, yy) of ``c cᵀ + C`` with the scatter C
    (:mod:`mbtf_fit.surface.slopes`), then base color b (3); of glossy surfaces besides α² and metallic m; of
    coated ones also weight w and α² of a clear coat.
    C is read with variances of at least 0 and a correlation within ±1. The normal is
    ``n = (-c_x, -c_y, 1) / ‖·‖``. Horizons hold, for equidistant azimuths from +u towards +v, the mean h of
    the horizon's elevation in the first half of the channels, the mean of its square in the second half,
    both linear between azimuths; v is their variance. The light is visible from the share

        (R2) V = Φ((asin ω_i,z - h) / √max(v + (light_blur · light_width)², least_variance)).

    With `heights`, V is the mean of that and of a shadow test. The ray from the light to an intersection at
    the height z first meets the heights at z'. Below, its light falls off with the distance:

        (R11) V' = exp(-(z' - z) / (ω_i,z light_depth)),

    which is soft as edges of shadows are, or as fibers let light pass; the width of the light is that of R2.

    Facets whose slopes have the center c and the matrix A show to a direction ω, per area of the reference
    plane, the area (Heitz 2014)

        (R4) P(ω; c, A) = (p + √(p² + ω_xyᵀ A ω_xy)) / 2,    p = ω_z - c·ω_xy.

    Irradiance: ``e = V n_z P(ω_i; c, 2C) / ω_i,z``, 1 on the reference plane. Core, in 1/sr: ``e b/π``, or of
    a glossy surface ``e T (1-m) b/π`` and the light that the visible facets reflect,

        (R5) V S F D(h) / (4 ω_i,z max(P(ω_o; c', A'), least_view)),

    with ``F = F0 + (F90 - F0) (1 - h·ω_o)⁵`` (Schlick 1994), ``F0 = (1-m) dielectric + m b``, ``F90 = (1-m)
    min(1, 50 dielectric) + m``, the half vector h, and the density D(h) of facets. GGX facets of α² about n
    are, in slopes of the plane, such facets about κ c with ``ρ (I + κ c cᵀ)``, where ``κ = (1-α²) / (1 + α²
    ‖c‖²)`` and ``ρ = α² (1 + ‖c‖²) / (1 + α² ‖c‖²)``. Below a footprint ``c' = κ c`` and ``A' = ρ (I + κ c
    cᵀ) + 2C``. α² is clamped to `alpha2`.

    The light gives the slopes ``s = -h_xy / h_z`` of half vectors the covariance

        (R7) W = (light_width / (ω_i,z + ω_o,z))² (I + s sᵀ - q qᵀ),    q = ω_i,xy + ω_i,z s.

    D averaged over the light is about a Voigt profile, a mixture of GGX facets and of a Gaussian:

        (R8) D = η / (π √det B (h_z² + gᵀ B⁻¹ g)²) + (1-η) exp(-gᵀ S⁻¹ g / (2 h_z²)) / (2π √det S h_z⁴),

    with ``g = h_xy + h_z c'``, ``B = A' + 2.5 W``, ``η = √(det A' / det B)``, ``S = W + (0.6 + 0.5 / (0.6 +
    √(det A' / det W))) A'``. The share η keeps the tails of GGX (Walter et al. 2007), which light does not
    widen; a delta light leaves η = 1.

    The mean cosine of the facets that a direction sees is about ``x(ω) = min(1, n_z √(p² + ω_xyᵀ 2C ω_xy))``.
    A clear coat with ``F_c(x) = w (0.04 + 0.96 (1 - x)⁵)`` adds such a lobe of its own α² and of the
    reflectance ``F_c(h·ω_o)``. Of the core below it the share

        (R6) (1 - E_c(ω_i)) (1 - E_c(ω_o)),    E_c(ω) = F_c(√(x² + k (1 - x²))),    k = α² / (0.06 + 2.5 α),

    is left. E_c is the albedo of the coat to 0.02 at cosines from 0.1. The lobe of the dielectric, of F0 and
    F90 with m = 0, has such an albedo E; its base scatters the rest (Kelemen and Szirmay-Kalos 2001),

        (R9) T = (1 - E(ω_i)) (1 - E(ω_o)) / (1 - F0 - (F90 - F0) 2 t⁶ (1/6 - t/7) / (1 - k)),    t = 1 - √k,

    with the cosine-weighted mean of E below the bar. Facets of a surface's own α² shadow each other, by Smith
    (Heitz 2014): of those that the viewer sees, the share

        (R10) S = x_i (x_o + a_o) / (x_i a_o + x_o a_i),    a = √(α² + (1 - α²) x²),

    is in the light; horizons know nothing of them.

    Attributes
    ----------
    hits, level, omega_i, omega_o : uv of intersections (2 each), fractional level (1), directions (3)
    maps, horizons : textures by level
    light_width, dielectric : tensors (): RMS angle per axis of the light in radians; F0 of what is no metal
    finer : levels
    depths, heights : heights of the intersections (1 per place), and tensor (rows, columns, 1) that shadow
        rays are traced to, those of :class:`~mbtf_fit.ops.lookup.Trace`; None for no shadow rays
    light_depth : tile widths, above 0
    """

    hits: Value
    level: Value
    omega_i: Value
    omega_o: Value
    maps: TextureName
    horizons: TextureName
    light_width: TensorName
    dielectric: TensorName
    finer: float = 0.0
    depths: Value | None = None
    heights: TensorName | None = None
    light_depth: float = LIGHT_DEPTH
    light_blur: float = LIGHT_BLUR
    least_view: float = LEAST_VIEW
    least_variance: float = LEAST_VARIANCE
    alpha2: tuple[float, float] = ALPHA2

    def size(self, sizes: Sequence[int]) -> int:
        if (self.depths is None) != (self.heights is None):
            raise ValueError(f"shade '{self.output}' needs both depths and heights, or neither")
        if self.depths is not None and 2 * sizes[4] != sizes[0]:
            raise ValueError(f"shade '{self.output}' needs one depth per place")
        if not self.light_depth > 0:
            raise ValueError(f"shade '{self.output}' has light_depth {self.light_depth:g}, not above 0")
        return 6


def adjacent_azimuths(horizons: NDArray[np.float32]) -> NDArray[np.float32]:
    """Horizons (rows, columns, 2n), means and then squares, as n groups of four: mean and square of an
    azimuth, and those of the next one."""
    mean, square = np.split(horizons, 2, axis=2)
    both = np.stack([mean, square, np.roll(mean, -1, -1), np.roll(square, -1, -1)], -1)
    return both.reshape(*mean.shape[:2], 4 * mean.shape[2])


def grazing_reflectance(f0: float) -> float:
    """Reflectance of a dielectric at grazing angles, from that along the normal: less than 1 below 2%."""
    return min(1.0, 50.0 * f0)


@dataclass(frozen=True)
class Lobe(Operation):
    """A diffuse and a GGX lobe (Walter et al. 2007; Fresnel: Schlick 1994).

    ``M = max(0, n·ω_i) / ω_i,z · (b/π + w GGX(F0, α²))`` with the normal ``n = (-s_x, -s_y, 1) / ‖·‖``: the
    light has the irradiance 1 on the reference plane, hence the division by ω_i,z. Cosines of light and view
    in the lobe are at least `least_light` and `least_view`.

    Attributes
    ----------
    base_color, specular, alpha2, slopes : b (3), F0 (1 or 3), α² (1) with α = roughness², slopes s (2);
        without slopes, ``Transform("flat", "omega_o[0:2]", scale=0.0)``
    omega_i, omega_o : directions (3)
    weight : w (1), which scales all of the lobe's reflectance, or None for 1
    least_alpha2 : bound of α² from below
    """

    base_color: Value
    specular: Value
    alpha2: Value
    slopes: Value
    omega_i: Value
    omega_o: Value
    weight: Value | None = None
    least_alpha2: float = 1e-4
    least_light: float = LEAST_LIGHT
    least_view: float = LEAST_VIEW

    def size(self, sizes: Sequence[int]) -> int:
        return 3

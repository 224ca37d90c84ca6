r"""Directions about the fibers below a footprint, whose lobes are cones about the fiber."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mbtf_fit.ops.constants import LEAST_FIBER_COSINE, LEAST_FIBER_VARIANCE, LEAST_TANGENTS
from mbtf_fit.ops.operation import Operation, TextureName, Value


@dataclass(frozen=True)
class FiberFrame(Operation):
    r"""Light and view about the fibers' axis (6): lobe c M, cosine of the azimuth cos φ, squares s_i², s_o²
    and product s_i s_o of the sines of the inclinations, coverage c; means over intersections.

    Maps are read at the level ``l + finer``. They hold, of the fibers seen from above below the footprint,
    the moments T of their unit tangents t (xx, xy, xz, yy, yz, zz) and their longitudinal variance V, both 0
    in gaps. With the coverage ``c = max(0, tr T)``, ``A = T / max(c, least_tangents)`` is the mean of t tᵀ
    over the fibers, and

        (F1) P = A⁸ / tr A⁸

    projects about onto their common axis, whatever the signs of the tangents. It takes three products; each
    is divided by its trace, or by 10⁻¹² if that is larger. Sines of the inclinations of light and view from
    the plane normal to the axis are

        (F2) s_i² = ω_iᵀ P ω_i,    s_o² = ω_oᵀ P ω_o,    s_i s_o = ω_iᵀ P ω_o,

    and the azimuth between both around it has

        (F3) cos φ = (ω_i·ω_o - s_i s_o) / max(√((1 - s_i²) (1 - s_o²)), least_cosine),

    within ±1. A fiber scatters light about the cone ``s_o = -s_i`` (Marschner et al. 2003). Tangents that
    differ from their axis widen it, here with h = ω_i + ω_o:

        (F4) M = exp(-m² / 2w) / √(2π w),    m² = (s_i + s_o)²,
             w = max(V / max(c, least_tangents) + max(0, hᵀ A h - m² tr(A P)), least_variance).

    Attributes
    ----------
    hits, level, omega_i, omega_o : uv of intersections (2 each), fractional level (1), directions (3)
    maps : textures by level
    finer : levels
    """

    hits: Value
    level: Value
    omega_i: Value
    omega_o: Value
    maps: TextureName
    finer: float = 0.0
    least_tangents: float = LEAST_TANGENTS
    least_cosine: float = LEAST_FIBER_COSINE
    least_variance: float = LEAST_FIBER_VARIANCE

    def size(self, sizes: Sequence[int]) -> int:
        return 6

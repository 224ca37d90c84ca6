"""The footprint of a hit: uv of the sides of the parallelogram that a sample of a pixel covers.

Mitsuba from 3.10 on projects the cones of camera rays onto surfaces. ``si.footprint`` is a matrix of these
sides as columns. Scenes compute it where a texture asks to be filtered. Earlier, ``si.duv_dx`` and
``si.duv_dy`` are fields that nothing sets.
"""

from __future__ import annotations

import mitsuba as mi

from mbtf_gen.engine.types import SurfaceInteraction3f, Vector2f


class FootprintRequest(mi.Texture):
    """A texture that nothing looks up, for which Mitsuba computes footprints."""

    def __init__(self) -> None:
        super().__init__(mi.Properties("footprint"))

    def filtered(self) -> bool:
        """Whether the texture needs footprints."""
        return True


def uv_partials(si: SurfaceInteraction3f) -> tuple[Vector2f, Vector2f]:
    """Both sides, 0 where no footprint is known."""
    if not hasattr(si, "footprint"):
        return si.duv_dx, si.duv_dy
    x, y = (mi.Vector2f(si.footprint[0, k], si.footprint[1, k]) for k in (0, 1))
    return x, y


def set_uv_partials(si: SurfaceInteraction3f, dx: Vector2f, dy: Vector2f) -> None:
    """Write both sides."""
    if not hasattr(si, "footprint"):
        si.duv_dx, si.duv_dy = dx, dy
        return
    si.footprint = mi.Matrix2f(dx.x, dy.x, dx.y, dy.y)

"""The frame of a tile on a surface: how texture coordinates stretch and shear it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_gen.engine.types import Float, SurfaceInteraction3f, Vector2f, Vector3f


@dataclass(frozen=True)
class Frame:
    """The tile's frame at hits: x and y are steps of the tile in the shading frame, in units in which they
    span an area of 1, as stretched and sheared as texture coordinates are. Directions of the tile are those
    in which rays cross its heights. It is upside down where side is -1; then tilted, over a curved surface.
    The tile has a width on the surface.
    """

    x: Vector2f
    y: Vector2f
    side: Float
    width: Float
    tilt: Vector2f | None = None

    @classmethod
    def at(cls, si: SurfaceInteraction3f, two_sided: bool = False, scale: Any = (1.0, 1.0)) -> Frame:
        """x along ∂p/∂u, y along -∂p/∂v of Mitsuba (images have row 0 there at v = 0), of tiles that have a
        scale per unit of u and v, z towards the viewer where the surface is two-sided."""
        du, dv = si.sh_frame.to_local(si.dp_du) / scale[0], si.sh_frame.to_local(si.dp_dv) / -scale[1]
        area = dr.abs(du.x * dv.y - du.y * dv.x)
        good, unit = area > 0.0, dr.rsqrt(area)
        x = dr.select(good, mi.Vector2f(du.x, du.y) * unit, mi.Vector2f(1.0, 0.0))
        y = dr.select(good, mi.Vector2f(dv.x, dv.y) * unit, mi.Vector2f(0.0, 1.0))
        side = dr.select(si.wi.z < 0, mi.Float(-1.0), 1.0) if two_sided else mi.Float(1.0)
        return cls(x, y, side, dr.sqrt(area))

    def to_tile(self, w: Vector3f) -> Vector3f:
        """Local direction → the tile's."""
        if self.tilt is not None:
            w = tilted(w, self.tilt)
        x = self._hand * dr.fma(w.x, self.y.y, -w.y * self.y.x)
        y = self._hand * dr.fma(w.y, self.x.x, -w.x * self.x.y)
        return dr.normalize(mi.Vector3f(x, y, self.side * w.z))

    def over(self, tilt: Vector2f) -> Frame:
        """The frame where the normal has changed by a slope over the tile's steps."""
        return replace(self, tilt=self.slope(tilt))

    def slope(self, s: Vector2f, sag: Vector3f | None = None) -> Vector2f:
        """Change per step of the tile → per length on the surface, or at a height z over one that is curved
        by a form, whose product is `sag`."""
        xx, xy, yy = dr.squared_norm(self.x), dr.dot(self.x, self.y), dr.squared_norm(self.y)
        if sag is not None:
            xx, xy, yy = xx + sag.x, xy + sag.y, yy + sag.z
        determinant = xx * yy - xy * xy
        along, across = yy * s.x - xy * s.y, xx * s.y - xy * s.x
        return (along * self.x + across * self.y) / determinant

    def spread(self, matrix: Sequence[Float], sag: Vector3f | None = None) -> tuple[Float, Float, Float]:
        """Covariance (xx, xy, yy) of slopes of the tile → of those on the surface."""
        xx, xy, yy = matrix
        a, b = self.slope(mi.Vector2f(xx, xy), sag), self.slope(mi.Vector2f(xy, yy), sag)
        p, q = self.slope(mi.Vector2f(a.x, b.x), sag), self.slope(mi.Vector2f(a.y, b.y), sag)
        return p.x, p.y, q.y

    def on_surface(self, w: Vector3f) -> Vector3f:
        """Unit vectors of the tile → of the surface, seen from its front."""
        return dr.normalize(mi.Vector3f(*self._vector(w).xy, w.z))

    @property
    def _hand(self) -> Float:
        """-1 where the frame is a mirror image."""
        return self.x.x * self.y.y - self.x.y * self.y.x

    def _vector(self, w: Vector3f) -> Vector3f:
        return mi.Vector3f(
            dr.fma(w.x, self.x.x, w.y * self.y.x), dr.fma(w.x, self.x.y, w.y * self.y.y), self.side * w.z
        )

    def to_local(self, w: Vector3f) -> Vector3f:
        """Inverse of :meth:`to_tile`."""
        w = dr.normalize(self._vector(w))
        return w if self.tilt is None else tilted(w, self.tilt, back=True)

    def length(self, w: Vector3f) -> Float:
        """Length on the surface of the tile's unit vectors; its cube is the solid angle in the tile's frame
        over that on the surface."""
        return dr.norm(self._vector(w))


def tilted(w: Vector3f, tilt: Vector2f, back: bool = False) -> Vector3f:
    """Directions in a frame whose normal is rotated by an angle towards a direction, or back from it."""
    angle = dr.norm(tilt)
    d = dr.select(angle > 0.0, tilt / angle, mi.Vector2f(1.0, 0.0))
    sin, cos = dr.sincos(-angle if back else angle)
    p = dr.fma(w.x, d.x, w.y * d.y)
    step = dr.fma(p, cos, -w.z * sin) - p
    rotated = mi.Vector3f(dr.fma(step, d.x, w.x), dr.fma(step, d.y, w.y), dr.fma(p, sin, w.z * cos))
    return dr.select(angle > 0.0, rotated, w)

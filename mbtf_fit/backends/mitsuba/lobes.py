r"""Importance sampling of a material: a mixture of two densities per texel.

One is the cosine-weighted hemisphere, the other reflects the view at the visible normals of an anisotropic,
tilted GGX distribution. Its slopes are ``s = L t + s0`` with t distributed as ``1/(π (1+|t|²)²)``. The normal
``(-s, 1)`` is then ``K (-t, 1)`` with ``K = [[L, -s0], [0, 1]]``, so that the normals visible from ω are the
images of the normals of a unit GGX visible from ``ω' = Kᵀω`` (Heitz 2018; there without the tilt), and the
density of the reflected direction is

    p(ω_i) = D(h) / (2 (|ω'| + ω'_z)),   D(h) = 1 / (π |det L| (1+|t|²)² h_z⁴).

Directions below the surface are discarded, so the density integrates to less than one. The weight of the lobe
depends on the view's cosine, by bands.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mbtf_fit.backends.mitsuba.textures import Textures, in_image
from mbtf_gen.engine.types import Float, Point2f, UInt32, Vector3f
from mbtf_gen.render.bsdf.microfacet import visible_normal

# Numbers per texel: L (11, 21, 22), s0 (x, y), the lobe's weight in each band of the view's cosine.
CHANNELS = 8
# Inner edges of the bands.
BANDS = (0.35, 0.7)


def band_of(cosine: Float) -> UInt32:
    """Number of the band of a view's cosine."""
    return dr.select(cosine < BANDS[0], mi.UInt32(0), dr.select(cosine < BANDS[1], mi.UInt32(1), 2))


@dataclass(frozen=True)
class SlopeLobe:
    """Reflection at a distribution of slopes: lower triangle of L, and s0."""

    l11: Float
    l21: Float
    l22: Float
    x: Float
    y: Float

    def deviation(self, half: Vector3f) -> tuple[Float, Float, Float]:
        """(slope x, slope y, |t|²) of half vectors of any length, z > 0."""
        inverse = 1.0 / half.z
        sx, sy = -half.x * inverse, -half.y * inverse
        tx = (sx - self.x) / self.l11
        ty = (sy - self.y - self.l21 * tx) / self.l22
        return sx, sy, dr.fma(tx, tx, ty * ty)

    def _stretched(self, viewer: Vector3f) -> Vector3f:
        """Kᵀ ω."""
        return mi.Vector3f(
            dr.fma(self.l11, viewer.x, self.l21 * viewer.y),
            self.l22 * viewer.y,
            viewer.z - self.x * viewer.x - self.y * viewer.y,
        )

    def density(self, light: Vector3f, viewer: Vector3f) -> Float:
        """Density of the light's direction in 1/sr for the viewer's direction, both with z > 0."""
        half = light + viewer
        _, _, square = self.deviation(half)
        cosine2 = dr.square(half.z) / dr.squared_norm(half)
        w = self._stretched(viewer)
        # |ω'| + ω'_z cancels for views far below the tilted plane.
        length = dr.norm(w)
        flat = dr.fma(w.x, w.x, w.y * w.y)
        sum_ = dr.select(w.z >= 0, length + w.z, flat / dr.maximum(length - w.z, 1e-20))
        below = 2.0 * dr.pi * self.l11 * self.l22 * dr.square((1.0 + square) * cosine2) * sum_
        return 1.0 / dr.maximum(below, 1e-20)

    def reflect(self, viewer: Vector3f, xi: Point2f) -> Vector3f:
        """Direction with that density; z may be negative."""
        t = visible_normal(dr.normalize(self._stretched(viewer)), 1.0, xi)
        half = dr.normalize(
            mi.Vector3f(
                dr.fma(self.l11, t.x, -self.x * t.z),
                dr.fma(self.l21, t.x, self.l22 * t.y) - self.y * t.z,
                t.z,
            )
        )
        return 2.0 * dr.dot(viewer, half) * half - viewer


@dataclass(frozen=True)
class Mixture:
    """The density for one view: the lobe with a weight, else cosine-weighted."""

    lobe: SlopeLobe
    weight: Float
    viewer: Vector3f

    @classmethod
    def cosine(cls, viewer: Vector3f) -> Mixture:
        """The cosine-weighted hemisphere alone."""
        one, none = mi.Float(1.0), mi.Float(0.0)
        return cls(SlopeLobe(one, none, one, none, none), none, viewer)

    def density(self, light: Vector3f) -> Float:
        """In 1/sr; 0 below the surface."""
        value = dr.lerp(dr.inv_pi * light.z, self.lobe.density(light, self.viewer), self.weight)
        return dr.select((light.z > 0) & (self.viewer.z > 0), value, 0.0)

    def sample(self, choice: Float, xi: Point2f) -> Vector3f:
        """Direction; to be discarded below the surface."""
        cosine = mi.warp.square_to_cosine_hemisphere(xi)
        return dr.select(choice < self.weight, self.lobe.reflect(self.viewer, xi), cosine)


class LobeTextures(Textures):
    """Lobes of a material by level and texel: textures of :data:`CHANNELS` channels."""

    def at(self, u: Point2f, level: Float, viewer: Vector3f) -> Mixture:
        """Mixture of the nearest texel of the nearest level at uv positions (Point2f)."""
        nearest = mi.UInt32(dr.clip(dr.round(level), 0.0, len(self.shapes) - 1.0))
        rows, columns, start, _ = dr.gather(mi.Vector4u, self.table, nearest)
        x = in_image(u)
        i = dr.minimum(mi.UInt32(x.x * mi.Float(columns)), columns - 1)
        j = dr.minimum(mi.UInt32(x.y * mi.Float(rows)), rows - 1)
        return mixture_of(self.buffer, start + j * columns + i, viewer)


def mixture_of(buffer: Float, texel: UInt32, viewer: Vector3f) -> Mixture:
    """Mixture of a texel of a buffer, by its number."""
    l11, l21, l22, x = dr.gather(mi.Vector4f, buffer, 2 * texel)
    y, *weights = dr.gather(mi.Vector4f, buffer, 2 * texel + 1)
    band = band_of(viewer.z)
    weight = dr.select(band == 0, weights[0], dr.select(band == 1, weights[1], weights[2]))
    return Mixture(SlopeLobe(l11, l21, l22, x, y), weight, viewer)

"""Importance sampling of a material: the mixture of two densities that its sampler predicts
(:mod:`mbtf_fit.ops.sampler`, which has the equations)."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mbtf_fit.backends.mitsuba.backend import Numbers
from mbtf_fit.ops.sampler import LARGEST_LOG, LARGEST_WEIGHT, LEAST_ALPHA
from mbtf_gen.engine.types import Float, Point2f, Vector3f
from mbtf_gen.render.bsdf.microfacet import visible_normal


@dataclass(frozen=True)
class SlopeLobe:
    """(S1) Reflection at a distribution of slopes: lower triangle of L, and s0."""

    l11: Float
    l21: Float
    l22: Float
    x: Float
    y: Float

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
        tx = (-half.x / half.z - self.x) / self.l11
        ty = (-half.y / half.z - self.y - self.l21 * tx) / self.l22
        square = dr.fma(tx, tx, ty * ty)
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
    def of(cls, x: Numbers, viewer: Vector3f) -> Mixture:
        """(S2) Of the sampler's outputs."""
        l11, l22 = (LEAST_ALPHA + dr.exp(dr.minimum(v, LARGEST_LOG)) for v in (x[0], x[2]))
        weight = LARGEST_WEIGHT / (1.0 + dr.exp(-x[5]))
        return cls(SlopeLobe(l11, x[1] * l22, l22, x[3], x[4]), weight, viewer)

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

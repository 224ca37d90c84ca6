r"""Importance sampling of a material: a mixture of two densities per texel.

One is the cosine-weighted hemisphere, the other reflects the view at the visible normals of an anisotropic,
tilted GGX distribution. Its slopes are ``s = L t + s0`` with t distributed as ``1/(π (1+|t|²)²)``. The normal
``(-s, 1)`` is then ``K (-t, 1)`` with ``K = [[L, -s0], [0, 1]]``, so that the normals visible from ω are the
images of the normals of a unit GGX visible from ``ω' = Kᵀω`` (Heitz 2018; there without the tilt), and the
density of the reflected direction is

    p(ω_i) = D(h) / (2 (|ω'| + ω'_z)),   D(h) = 1 / (π |det L| (1+|t|²)² h_z⁴).

Directions below the surface are discarded, so the density integrates to less than one. The weight of the lobe
depends on the view's cosine, by bands.

Lobes are fitted to a material's values by expectation maximization. For every texel, views and lights are
sampled and the material is evaluated; the values times the light's cosine are the weights of samples of the
target density. The GGX distribution of slopes is a bivariate Student distribution of two degrees of freedom,
whose maximum-likelihood fit is a fixed-point iteration (Lange, Little and Taylor 1989), as is that of a
mixture's weights (Dempster, Laird and Rubin 1977). The update neglects directions below the surface and the
normals' visibility: both shift the lobe slightly, which increases the variance but causes no bias.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mbtf_fit.backends.mitsuba.evaluator import Evaluator
from mbtf_fit.backends.mitsuba.stored_material import F32
from mbtf_fit.backends.mitsuba.textures import Textures, in_image
from mbtf_gen.engine.types import Float, Point2f, UInt32, Vector3f
from mbtf_gen.render.bsdf.microfacet import visible_normal

# Numbers per texel: L (11, 21, 22), s0 (x, y), the lobe's weight in each band of the view's cosine.
CHANNELS = 8
# Inner edges of the bands.
BANDS = (0.35, 0.7)
# Finest level with lobes, samples per texel, iterations.
FINEST = 6
SAMPLES = 256
ITERATIONS = 10
# Initial lobe of the sampling and of the iteration: α and weight.
FIRST_ALPHA = 0.4
FIRST_WEIGHT = 0.5
# Smallest α: the values are blurred by the light kernel, and single precision is limited.
SMALLEST_ALPHA = 0.03
# Weight of the initial lobe as a prior, in samples of a texel.
PRIOR = 1.5
# Candidate weights of the lobe, less than 1, so that every direction has a positive density.
WEIGHTS = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9)
# Weight of the level's mean in the selection.
LEVEL_WEIGHT = 0.5
# Penalty of a lobe of weight 1: small improvements are noise.
PENALTY = 0.1
# Lanes per launch.
_LANES = 1 << 22


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


def fit_lobes(evaluator: Evaluator) -> list[F32]:
    """Lobes (rows, columns, 8) of each level up to :data:`FINEST`, in a second or two."""
    lattice, most, out = evaluator.lattice, _LANES // SAMPLES, []
    for level in range(min(lattice.finest, FINEST) + 1):
        texels = lattice.texels(level)
        parts = [_fit_texels(evaluator, level, k, min(most, texels - k)) for k in range(0, texels, most)]
        out.append(np.concatenate(parts).reshape(*lattice.shape(level), CHANNELS))
    return out


def _fit_texels(evaluator: Evaluator, level: int, first: int, count: int) -> F32:
    """Lobes (count, 8) of texels of a level from number `first` on, row by row."""
    rows, columns = evaluator.lattice.shape(level)
    lane = dr.arange(mi.UInt32, count * SAMPLES)
    texel = lane // SAMPLES
    at = texel + dr.opaque(mi.UInt32, first)
    row, column = at // dr.opaque(mi.UInt32, columns), at % dr.opaque(mi.UInt32, columns)
    # Jittered positions: the lobe represents the whole texel.
    random = mi.PCG32(initstate=at, initseq=lane % SAMPLES)
    jitter_u, jitter_v = random.next_float32(), random.next_float32()
    u = mi.Point2f(
        (mi.Float(column) + jitter_u) / dr.opaque(mi.Float, columns),
        1.0 - (mi.Float(row) + jitter_v) / dr.opaque(mi.Float, rows),
    )
    xi = mi.Point2f(random.next_float32(), random.next_float32())
    viewer = mi.warp.square_to_cosine_hemisphere(xi)
    viewer.z = dr.maximum(viewer.z, 0.02)
    viewer = dr.normalize(viewer)
    alpha, none = mi.Float(FIRST_ALPHA), mi.Float(0.0)
    start = Mixture(SlopeLobe(alpha, none, alpha, none, none), mi.Float(FIRST_WEIGHT), viewer)
    choice = random.next_float32()
    light = start.sample(choice, mi.Point2f(random.next_float32(), random.next_float32()))
    above = light.z > 1e-3
    light = dr.select(above, light, mi.Vector3f(0, 0, 1))
    value = evaluator.value(evaluator.stage1(u, dr.opaque(mi.Float, float(level)), viewer), light)
    density = start.density(light)
    target = dr.select(above, dr.mean(value) * light.z, 0.0)
    weight = target / density
    dr.eval(viewer, light, target, density, weight, texel)
    buffer = _iterate(weight, viewer, light, texel, count)
    out: F32 = np.array(buffer, np.float32).reshape(count, CHANNELS)
    lobe = mixture_of(buffer, texel, viewer).lobe.density(light, viewer)
    out[:, 5:] = _best_weights(lobe, target, density, viewer, light)
    return out


def _iterate(weight: Float, viewer: Vector3f, light: Vector3f, texel: UInt32, count: int) -> Float:
    """Expectation maximization: buffer of the lobes of `count` texels from samples with weights."""

    def total(x: Float) -> Float:
        return dr.block_sum(x, SAMPLES)

    first = np.array([FIRST_ALPHA, 0, FIRST_ALPHA, 0, 0, *3 * [FIRST_WEIGHT]], np.float32)
    buffer = mi.Float(np.tile(first, count))
    half = light + viewer
    # The prior counts as samples of the mean weight; a black texel keeps it.
    all_ = total(weight)
    prior = PRIOR * dr.maximum(all_ / SAMPLES, 1e-12)
    for _ in range(ITERATIONS):
        mixture = mixture_of(buffer, texel, viewer)
        lobe, lobe_weight = mixture.lobe, mixture.weight
        density = lobe.density(light, viewer)
        mixed = dr.lerp(dr.inv_pi * light.z, density, lobe_weight)
        by_lobe = weight * lobe_weight * density / dr.maximum(mixed, 1e-20)
        sx, sy, square = lobe.deviation(half)
        # Student weights (ν + 2)/(ν + δ) with ν = 2 and δ = 2|t|².
        robust = 2.0 * by_lobe / (1.0 + square)
        moments = [robust, robust * sx, robust * sy, robust * sx * sx, robust * sx * sy, robust * sy * sy]
        sums = [total(m) for m in moments]
        lobe_total = total(by_lobe) + prior
        lobe_weight = dr.clip((lobe_total - prior + FIRST_WEIGHT * prior) / (all_ + prior), 0.02, WEIGHTS[-1])
        s = sums[0] + prior
        x, y = sums[1] / s, sums[2] / s
        # Scatter about the new center; L Lᵀ is twice the Student distribution's own matrix.
        own = prior * FIRST_ALPHA**2 / 2.0
        xx = sums[3] - 2 * x * sums[1] + x * x * sums[0] + own
        xy = sums[4] - x * sums[2] - y * sums[1] + x * y * sums[0]
        yy = sums[5] - 2 * y * sums[2] + y * y * sums[0] + own
        least = SMALLEST_ALPHA**2
        l11 = dr.sqrt(2.0 * xx / lobe_total + least)
        l21 = 2.0 * xy / lobe_total / l11
        l22 = dr.sqrt(dr.maximum(2.0 * yy / lobe_total - l21 * l21, 0.0) + least)
        fresh = dr.zeros(mi.Float, CHANNELS * count)
        index = CHANNELS * dr.arange(mi.UInt32, count)
        for k, number in enumerate((l11, l21, l22, x, y, lobe_weight, lobe_weight, lobe_weight)):
            dr.scatter(fresh, number, index + k)
        dr.eval(fresh)
        buffer = fresh
    return buffer


def _best_weights(lobe: Float, target: Float, start: Float, viewer: Vector3f, light: Vector3f) -> F32:
    """Weight (texels, 3) of the lobe of that density in each band: that of :data:`WEIGHTS` with the least
    second moment of ``target / density``, which includes the loss of directions below the surface."""
    band = band_of(viewer.z)
    moments = np.empty((dr.width(target) // SAMPLES, len(BANDS) + 1, len(WEIGHTS)))
    for c, lobe_weight in enumerate(WEIGHTS):
        moment = dr.square(target) / (start * dr.lerp(dr.inv_pi * light.z, lobe, mi.Float(lobe_weight)))
        for k in range(len(BANDS) + 1):
            moments[:, k, c] = np.array(dr.block_sum(dr.select(band == k, moment, 0.0), SAMPLES))
    # The selection from few samples is noisy: the level's mean regularizes it.
    relative = moments / np.maximum(moments.mean(-1, keepdims=True), 1e-30)
    cost = (relative + LEVEL_WEIGHT * relative.mean(0)) * (1.0 + PENALTY * np.array(WEIGHTS))
    best = np.argmin(cost, -1)
    out: F32 = np.array(WEIGHTS, np.float32)[best]
    return out

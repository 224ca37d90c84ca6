"""Bias bounds of leaving effects out: from a pilot, or estimated on a height grid.

On a height grid, rays are marched over the periodic heights, and a Lambert surface is shaded with and without
an effect. By Jensen's inequality the root mean square change at points (σ → 0) is at least that of footprint
averages, so it bounds the bias for any mixture of levels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.render.estimates import Estimates
from mbtf_gen.sampling.light_kernel import LightKernel
from mbtf_gen.tile.heights import HeightGrid, height_slopes

F64 = NDArray[np.float64]

# Rays per estimate.
POINTS = 4096
# Standard errors of the mean square that are added to an estimate.
CAUTION = 2.0
# If fewer samples than these change, the largest change may be unsampled.
FEW = 8
# An event that occurs in none of n samples has a probability below 3/n, at 95% confidence (rule of three).
NONE_OF = 3.0
# The contribution to the mean square of changes larger than the largest sampled one, in units of its own
# contribution: α/(α-1) for a power-law tail of exponent α, so 10 is safe for α = 1.1.
UNSEEN = 10.0
# Steps after which a marched ray is assumed to be unoccluded.
MAX_STEPS = 4096


@dataclass(frozen=True)
class Change:
    """Change of a sample of queries when something is left out, relative to the mean value.

    Attributes
    ----------
    count : queries; changed : queries with any change
    square, error : mean square change and its standard error. The product of both halves' changes estimates
        it without bias from noise.
    shift, shift_error : mean change and its standard error
    largest : largest change of a query
    """

    count: int
    changed: int
    square: float
    error: float
    shift: float
    shift_error: float
    largest: float

    @classmethod
    def of(cls, full: Estimates, cut: Estimates) -> Change:
        """Change between two estimates of the same queries."""
        a = (full.value_a - cut.value_a).astype(np.float64)
        b = (full.value_b - cut.value_b).astype(np.float64)
        mean = 0.5 * float(np.mean(full.value_a + full.value_b))
        n = len(a)
        if mean <= 0.0:
            return cls(n, 0, 0.0, 0.0, 0.0, 0.0, 0.0)
        square = np.mean(a * b, axis=-1) / mean**2
        change = 0.5 * np.mean(a + b, axis=-1) / mean
        return cls(
            n,
            int(np.count_nonzero(change)),
            float(square.mean()),
            float(square.std()) / np.sqrt(n),
            float(change.mean()),
            float(change.std()) / np.sqrt(n),
            float(np.sqrt(max(np.abs(square).max(), (change**2).max()))),
        )

    @property
    def rms(self) -> float:
        """Root mean square change."""
        return float(np.sqrt(max(self.square, 0.0)))

    @property
    def upper(self) -> float:
        """Root mean square change plus :data:`CAUTION` standard errors, and at least the mean change plus as
        many: rare changes that never occur in both halves still shift the mean."""
        square = max(self.square, 0.0) + CAUTION * self.error
        return max(float(np.sqrt(square)), abs(self.shift) + CAUTION * self.shift_error)

    def bound(self, most: float = np.inf) -> float:
        """Upper bound of the root mean square change, including changes too rare for the sample. If no change
        exceeds `most`, the mean square is at most `most` times the mean."""
        # We assume that an unsampled change equals the mean value.
        largest = self.largest if self.changed >= FEW else max(self.largest, 1.0)
        seen = self.upper**2 + UNSEEN * largest**2 / self.count
        mean = abs(self.shift) + CAUTION * self.shift_error + NONE_OF * largest / self.count
        return float(np.sqrt(min(seen, most * mean)))


@dataclass(frozen=True)
class DisplacementBounds:
    """Bias bounds of leaving out effects of a displaced Lambert surface, relative to the mean value.

    Attributes
    ----------
    parallax : the plane, shaded with the mesh's slopes and without shadows, replaces the displaced tile
    shadowing : no shadows on the displaced tile
    normal : shading without the given residual slopes
    opacity : surface and occluders opaque everywhere
    """

    parallax: float
    shadowing: float
    normal: float
    opacity: float


class _Field:
    """Bilinear periodic samples of a grid."""

    def __init__(self, values: F64, aspect: float) -> None:
        self.values, self.aspect = values, aspect

    def __call__(self, x: F64, y: F64) -> F64:
        rows, columns = self.values.shape[:2]
        i = x * columns - 0.5
        j = (1.0 - y / self.aspect) * rows - 0.5
        i0, j0 = np.floor(i).astype(np.int64), np.floor(j).astype(np.int64)
        s, t = i - i0, j - j0
        if self.values.ndim == 3:
            s, t = s[:, None], t[:, None]
        i0, i1, j0, j1 = i0 % columns, (i0 + 1) % columns, j0 % rows, (j0 + 1) % rows
        v = self.values
        top = v[j0, i0] * (1 - s) + v[j0, i1] * s
        low = v[j1, i0] * (1 - s) + v[j1, i1] * s
        out: F64 = top * (1 - t) + low * t
        return out


def _march(
    field: _Field, origin: F64, direction: F64, step: float, depth: float
) -> tuple[F64, NDArray[np.bool_]]:
    """First points (n, 3) of rays below the heights, and which rays reach one before they leave the heights'
    range of `depth`."""
    if depth == 0.0:
        return origin, np.zeros(len(origin), bool)
    horizontal = np.hypot(direction[:, 0], direction[:, 1])
    # A step moves at most one cell horizontally and a fiftieth of the depth vertically.
    pace = 1.0 / np.maximum(horizontal / step, np.abs(direction[:, 2]) / (0.02 * depth))
    point = origin.copy()
    hit = np.zeros(len(origin), bool)
    active = np.arange(len(origin))
    for _ in range(MAX_STEPS):
        if not len(active):
            break
        point[active] += direction[active] * pace[active, None]
        p = point[active]
        below = p[:, 2] < field(p[:, 0], p[:, 1])
        hit[active[below]] = True
        active = active[~below & (p[:, 2] <= 0.0) & (p[:, 2] >= -1.01 * depth)]
    return point, hit


def _lambert(slope: F64, light: F64, irradiance: F64) -> F64:
    """Reflected share of unit irradiance on the reference plane, for facets (n, 2) of given slopes."""
    up = 1.0 / np.sqrt(1.0 + np.sum(slope**2, axis=-1))
    cosine = up * (light[:, 2] - np.sum(slope * light[:, :2], axis=-1))
    lit = np.where(light[:, 2] > 0, np.maximum(cosine, 0.0) / irradiance, 0.0)
    return np.asarray(lit[:, None])


def displacement_bounds(
    grid: HeightGrid,
    omega_i: F64,
    omega_o: F64,
    kernel: LightKernel,
    albedo: F64,
    residual: F64 | None = None,
    through: F64 | None = None,
) -> DisplacementBounds:
    """Estimate bias bounds from pairs of directions.

    Parameters
    ----------
    grid : heights
    omega_i, omega_o : (n, 3) directions with the run's distribution
    kernel : light around omega_i
    albedo : (h, w, channels) reflectance, any resolution
    residual : (h, w, 2) slopes that a normal map adds
    through : (h, w) fraction of the rays that pass through the surface
    """
    heights = _Field(grid.z, grid.aspect)
    slopes = _Field(height_slopes(grid), grid.aspect)
    color = _Field(albedo, grid.aspect)
    step = 1.0 / grid.z.shape[1]
    n = len(omega_i)
    rng = np.random.default_rng(0)
    foot = np.column_stack([rng.random(n), rng.random(n) * grid.aspect, np.zeros(n)])

    met, _ = _march(heights, foot, -omega_o, step, grid.displacement_range)
    start = met.copy()
    start[:, 2] = heights(met[:, 0], met[:, 1]) + 0.02 * grid.displacement_range
    light, irradiance = kernel.sample(omega_i, rng), kernel.irradiance(omega_i)
    up = np.column_stack([light[:, :2], np.maximum(light[:, 2], 1e-6)])
    occluder, blocked = _march(heights, start, up, step, grid.displacement_range)
    shadowed = blocked[:, None]

    there = slopes(met[:, 0], met[:, 1])
    shade = color(met[:, 0], met[:, 1]) * _lambert(there, light, irradiance)
    value = np.where(shadowed, 0.0, shade)
    here = color(foot[:, 0], foot[:, 1]) * _lambert(slopes(foot[:, 0], foot[:, 1]), light, irradiance)
    mean = max(float(value.mean()), 1e-12)

    largest = float(max(shade.max(), here.max())) ** 2

    def bound(change: F64) -> float:
        square = np.mean(change**2, axis=1)
        upper = square.mean() + CAUTION * square.std() / np.sqrt(n)
        if np.count_nonzero(square) < FEW:
            upper += NONE_OF * largest / n
        return float(np.sqrt(upper)) / mean

    normal = 0.0
    if residual is not None:
        tilted = there + _Field(residual, grid.aspect)(met[:, 0], met[:, 1])
        normal = bound(
            np.where(shadowed, 0.0, color(met[:, 0], met[:, 1]) * _lambert(tilted, light, irradiance) - shade)
        )
    opacity = 0.0
    if through is not None:
        passing = _Field(through, grid.aspect)
        seen, lit = (passing(p[:, 0], p[:, 1])[:, None] for p in (met, occluder))
        # Behind a hole lies another point of the same surface, lit about as strongly: the squares add.
        behind = np.roll(value, 1, axis=0)
        with_holes = (1.0 - seen) * np.where(shadowed, lit, 1.0) * shade
        change = np.sqrt((with_holes - value) ** 2 + (seen * behind) ** 2)
        # Relative to the mean value with holes.
        opacity = bound(change) * mean / max(float(with_holes.mean()), 1e-12)
    return DisplacementBounds(bound(here - value), bound(shade - value), normal, opacity)

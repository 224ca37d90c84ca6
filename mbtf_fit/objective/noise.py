"""Noise of the data: typical value, and a variance model that is pooled over queries.

The two halves of a single query hardly determine its noise, and a weight derived from them is correlated with
that noise, which causes a bias. Pooled over queries, the halves give a variance that depends on value,
footprint and directions alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_core.directions import ELEVATION_BANDS
from mbtf_core.stats import elevation_groups, level_groups, pooled_variance, signal_variance
from mbtf_fit.data.queries import ShardQueries

# Queries per group of the median of means.
_GROUP = 1024
_FEW_GROUPS = 101
# Fewest queries of a cell, and fewest cells of a level with coefficients of its own.
_LEAST_QUERIES = 8
_LEAST_CELLS = 12
# Fraction of the cells, those with the largest residuals, that the second fit omits.
_TRIMMED = 0.05
# Largest noise-to-signal ratio, also of constant values.
_MOST_NOISE = 5.0
# Fraction of the queries, the brightest, that the ratio omits: highlights, whose variance would hide the
# noise of all others, and outliers.
_BRIGHTEST = 0.01
# Least and most bound of learned values, in units.
LEAST_BOUND, _MOST_BOUND = 10.0, 1e30


def value_bound(values: ArrayLike, unit: float) -> float:
    """Bound of learned values in units: twice the largest of training values (n, ...).

    Networks that learn logarithms may answer more by orders of magnitude between the directions of the data.
    The factor is for highlights that no query meets at their peak, the least bound for few queries.
    """
    largest = 2.0 * float(np.max(values, initial=0.0))
    return min(max(LEAST_BOUND, largest / unit), _MOST_BOUND) if unit > 0.0 else LEAST_BOUND


def typical_value(values: ArrayLike) -> float:
    """Robust mean of values (n, ...) in random order: the median of the means of groups. The plain mean where
    that is 0.
    """
    flat = np.asarray(values)
    flat = flat.reshape(len(flat), -1)
    n = len(flat)
    groups = max(min(_FEW_GROUPS, n // 8), n // _GROUP, 1)
    size = n // groups
    # A group that overflows float32 is an outlier of the median.
    with np.errstate(over="ignore"):
        means = flat[: size * groups].reshape(groups, -1).mean(1, dtype=np.float64)
    middle = float(np.median(means))
    return middle if middle > 0 else max(0.0, float(flat.mean(dtype=np.float64)))


@dataclass(frozen=True)
class NoiseModel:
    """Variance of a query's value (the mean of its halves) as a function of its true value t:
    ``f · (c₀ s² + c₁ s t + c₂ t²)``, c by level, f by elevation band.

    Attributes
    ----------
    scale : s, the typical value of the data in 1/sr
    overall : (3,) c over all levels
    levels : (k+1, 3) c by nearest level
    bands : factors by band of the lower cosine (``ELEVATION_BANDS``)
    ratio : noise-to-signal ratio, noise variance over variance of the true values, of all queries but the
        brightest hundredth; at most 5
    """

    scale: float
    overall: NDArray[np.float64]
    levels: NDArray[np.float64]
    bands: NDArray[np.float64]
    ratio: float

    @classmethod
    def silent(cls, scale: float, lattice: Lattice) -> NoiseModel:
        """No noise."""
        bands = np.ones(len(ELEVATION_BANDS) - 1)
        return cls(scale, np.zeros(3), np.zeros((lattice.finest + 1, 3)), bands, 0.0)

    @classmethod
    def of(cls, queries: ShardQueries, lattice: Lattice, scale: float) -> NoiseModel:
        """Fit to queries (n, ...) with their halves.

        Queries are pooled in cells of like level, directions and position; over a cell's queries the means
        of ``(a-b)²/4``, ``(a+b)/2`` and ``ab`` are unbiased for the noise, t and t². Non-negative
        least squares of relative errors fit the coefficients to the cells, twice: the second time without the
        cells of largest residuals, so that the fit is robust to outliers.
        """
        if len(queries) == 0 or scale <= 0:
            return cls.silent(scale, lattice)
        level, band, means, counts = _cells(queries, lattice, scale)
        overall, kept = _coefficients(means, counts)
        levels = np.tile(overall, (lattice.finest + 1, 1))
        for s in range(lattice.finest + 1):
            mine = level == s
            if mine.sum() >= _LEAST_CELLS:
                levels[s], inside = _coefficients(means[mine], counts[mine])
                kept[mine] = inside
        explained = (means[:, 1:] * levels[level]).sum(1)
        bands = np.ones(len(ELEVATION_BANDS) - 1)
        for b in range(len(bands)):
            mine = kept & (band == b)
            below = float((counts * explained)[mine].sum())
            if below > 0:
                bands[b] = np.clip(float((counts * means[:, 0])[mine].sum()) / below, 0.1, 10.0)
        return cls(scale, overall, levels, bands, _ratio(queries))

    def variance(self, value: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Noise variance in 1/sr² where the true value is `value`: (n, 3), or (items, rows, columns, 3) where
        each item has one footprint and one pair of directions."""
        c = torch.as_tensor(self.levels, dtype=value.dtype, device=value.device)
        f = torch.as_tensor(self.bands, dtype=value.dtype, device=value.device)
        edges = torch.tensor(ELEVATION_BANDS[1:-1], dtype=sigma.dtype, device=sigma.device)
        level = (-torch.log2(2 * sigma)).round().clamp(0, len(c) - 1).long()
        band = torch.bucketize(torch.minimum(omega_i[:, 2], omega_o[:, 2]), edges, right=True)
        per_query = (len(sigma), *[1] * (value.ndim - 1))
        c0, c1, c2 = ((c[level, k] * f[band]).view(per_query) for k in range(3))
        t = value.clamp_min(0)
        return c0 * self.scale**2 + t * (c1 * self.scale + c2 * t)

    def spread(self, value: Tensor) -> Tensor:
        """``√(s² + noise variance)`` of values t, over all levels: the scale of a query's error."""
        c0, c1, c2 = (float(c) for c in self.overall)
        t = value.abs()
        return ((1 + c0) * self.scale**2 + t * (c1 * self.scale + c2 * t)).sqrt_()


def _ratio(queries: ShardQueries) -> float:
    n = len(queries)
    bright = (queries.value_a + queries.value_b).reshape(n, -1).mean(1)
    kept = np.sort(np.argsort(bright)[: max(1, n - math.ceil(_BRIGHTEST * n))])
    halves = queries.value_a[kept], queries.value_b[kept]
    noise, signal = pooled_variance(*halves).value, signal_variance(*halves).value
    if not noise > 0:
        return 0.0
    # False for NaN too, the variance of a single query.
    return noise / signal if signal > noise / _MOST_NOISE else _MOST_NOISE


def _per_query(array: NDArray[np.float64]) -> NDArray[np.float64]:
    return array.reshape(len(array), -1).mean(1)


def _cells(
    queries: ShardQueries, lattice: Lattice, scale: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """(level, band, means, counts) of the cells; means (cells, 4) of noise, 1, t and t², in units of s."""
    n = len(queries)
    a, b = queries.value_a / np.float64(scale), queries.value_b / np.float64(scale)
    columns = np.stack(
        [_per_query((a - b) ** 2 / 4), np.ones(n), _per_query((a + b) / 2), _per_query(a * b)], 1
    )
    # The queries of an image share footprint and directions.
    sigma = queries.sigma.reshape(n, -1)[:, 0]
    omega_i, omega_o = (w.reshape(n, -1)[:, :3] for w in (queries.omega_i, queries.omega_o))
    level = level_groups(sigma, lattice.finest)
    band, light = elevation_groups(omega_i, omega_o), elevation_groups(omega_i)
    u = np.clip((4 * queries.u.reshape(n, -1)[:, :2]).astype(np.int64), 0, 3)
    labels = (((level * 4 + band) * 4 + light) * 4 + u[:, 0]) * 4 + u[:, 1]
    found, index, counts = np.unique(labels, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(index, column) / counts for column in columns.T], 1)
    means[:, 2:] = means[:, 2:].clip(0)
    enough = counts >= min(_LEAST_QUERIES, counts.max())
    return found[enough] // 256, found[enough] // 64 % 4, means[enough], counts[enough].astype(np.float64)


def _coefficients(
    means: NDArray[np.float64], counts: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(c (3,), which cells were kept)."""
    from scipy.optimize import nnls

    kept = np.ones(len(means), bool)
    for trimmed in (True, False):
        weights = (np.sqrt(counts) / (1 + means[:, 3]))[kept, None]
        c, _ = nnls(weights * means[kept, 1:], weights[:, 0] * means[kept, 0])
        if trimmed:
            excess = np.abs(means[:, 0] - means[:, 1:] @ c) / (1 + means[:, 3]) * np.sqrt(counts)
            kept = excess <= np.quantile(excess, 1 - _TRIMMED)
    return c, kept

"""Statistics of a data set for its card, in one pass over the shards.

Error bars count what is independent: queries of the shuffled layout, images of the image layout, positions of
the slices layout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import level_of_sigma
from mbtf_core.data.shard_files import Arrays
from mbtf_core.stats.estimate import Estimate
from mbtf_gen.measured.exported import mean_of

F64 = NDArray[np.float64]

# Histogram of values: decades, and bins of a decade.
LOWEST_DECADE, HIGHEST_DECADE, PER_DECADE = -8, 6, 40
# Rows of shards that are averaged at once.
_BLOCK_VALUES = 1 << 20


class Moments:
    """First and second moments of several quantities over independent units."""

    def __init__(self, quantities: int) -> None:
        self.n = 0
        self.first = np.zeros(quantities)
        self.second = np.zeros((quantities, quantities))

    def add(self, units: F64) -> None:
        """Add units (n, quantities)."""
        self.n += len(units)
        self.first += units.sum(axis=0)
        self.second += units.T @ units

    def mean(self, quantity: int) -> Estimate:
        """Mean of a quantity with its standard error."""
        gradient = np.zeros(len(self.first))
        gradient[quantity] = 1.0
        return Estimate(float(self.first[quantity]) / max(self.n, 1), self._error(gradient), self.n)

    def root_ratio(self, square: int, other: int) -> Estimate:
        """√(mean of `square`) ÷ mean of `other`, with its error to first order."""
        a, b = (float(self.first[k]) / max(self.n, 1) for k in (square, other))
        if a <= 0 or b <= 0:
            return Estimate(0.0, 0.0 if a == 0 else math.inf, self.n)
        gradient = np.zeros(len(self.first))
        gradient[square], gradient[other] = 0.5 / (math.sqrt(a) * b), -math.sqrt(a) / b**2
        return Estimate(math.sqrt(a) / b, self._error(gradient), self.n)

    def _error(self, gradient: F64) -> float:
        """Standard error of a function of the means with this gradient (delta method)."""
        if self.n < 2:
            return math.inf
        mean = self.first / self.n
        covariance = (self.second / self.n - np.outer(mean, mean)) / (self.n - 1)
        return math.sqrt(max(0.0, float(gradient @ covariance @ gradient)))


# Quantities of the moments: the three channels, their mean, and the mean of the variances of their estimates.
_VALUE, _VARIANCE = 3, 4


@dataclass
class SplitStatistics:
    """Statistics of a split.

    Attributes
    ----------
    estimates : int
        Values per query: 2, or 1 of measured data, whose noise is unknown.
    queries : int
        Number of queries.
    overall : Moments
        Of all units.
    levels : dict of int to Moments
        Of the units whose footprint is nearest to a level.
    level_queries : dict of int to int
        Queries of these levels.
    histogram : (bins, 3) int array
        Positive values per channel, in logarithmic bins.
    not_positive : (3,) int array
        Values per channel that are 0 or negative.
    lowest, highest : float
        Smallest and largest value of any channel, 1/sr.
    """

    estimates: int = 2
    queries: int = 0
    overall: Moments = field(default_factory=lambda: Moments(5))
    levels: dict[int, Moments] = field(default_factory=dict)
    level_queries: dict[int, int] = field(default_factory=dict)
    histogram: NDArray[np.int64] = field(
        default_factory=lambda: np.zeros(((HIGHEST_DECADE - LOWEST_DECADE) * PER_DECADE, 3), np.int64)
    )
    not_positive: NDArray[np.int64] = field(default_factory=lambda: np.zeros(3, np.int64))
    lowest: float = math.inf
    highest: float = -math.inf

    def add(self, arrays: Arrays, finest: int) -> None:
        """Add rows of a shard."""
        value = mean_of(arrays).astype(np.float64)
        variance = np.zeros(value.shape[:-1])
        if self.estimates == 2:
            difference = arrays["value_a"].astype(np.float64) - arrays["value_b"]
            variance = (difference**2).mean(axis=-1) / 4
        quantities = np.concatenate(
            [value, value.mean(axis=-1, keepdims=True), variance[..., None]], axis=-1
        ).reshape(len(value), -1, 5)
        units = quantities.mean(axis=1)
        self.overall.add(units)
        one = arrays["sigma"].reshape(len(value), -1)
        nearest = np.clip(np.rint(level_of_sigma(one[:, 0])), 0, finest).astype(int)
        for level in np.unique(nearest):
            found = nearest == level
            self.levels.setdefault(int(level), Moments(5)).add(units[found])
            count = int(found.sum()) * one.shape[1]
            self.level_queries[int(level)] = self.level_queries.get(int(level), 0) + count
        self.queries += one.size
        self.lowest, self.highest = (
            min(self.lowest, float(value.min())),
            max(self.highest, float(value.max())),
        )
        edges = len(self.histogram)
        for channel in range(3):
            numbers = value[..., channel].reshape(-1)
            positive = numbers[numbers > 0]
            self.not_positive[channel] += numbers.size - positive.size
            index = np.floor((np.log10(positive) - LOWEST_DECADE) * PER_DECADE).astype(np.int64)
            self.histogram[:, channel] += np.bincount(np.clip(index, 0, edges - 1), minlength=edges)

    def mean(self, channel: int = _VALUE) -> Estimate:
        """Mean value of a channel, or of all three, in 1/sr."""
        return self.overall.mean(channel)

    def noise(self, level: int | None = None) -> Estimate | None:
        """Pooled noise relative to the mean, √(mean variance) ÷ mean value, of one level or of all; None of
        measured data."""
        if self.estimates == 1:
            return None
        return (self.overall if level is None else self.levels[level]).root_ratio(_VARIANCE, _VALUE)

    def quantile(self, share: float) -> float:
        """Value below which a share of the values of all channels lies, to 6 %."""
        counts = self.histogram.sum(axis=1)
        wanted = share * (counts.sum() + self.not_positive.sum()) - self.not_positive.sum()
        if wanted <= 0:
            return min(self.lowest, 0.0)
        index = int(np.searchsorted(np.cumsum(counts), wanted))
        middle = LOWEST_DECADE + (min(index, len(counts) - 1) + 0.5) / PER_DECADE
        return float(np.clip(10.0**middle, self.lowest, self.highest))


def blocks(arrays: Arrays) -> list[Arrays]:
    """Consecutive rows of a shard, few enough to compute with in memory."""
    total = len(arrays["sigma"])
    rows = max(1, _BLOCK_VALUES // max(1, arrays["sigma"][:1].size))
    return [{n: a[start : start + rows] for n, a in arrays.items()} for start in range(0, total, rows)]


def split_statistics(data: Dataset, split: str) -> SplitStatistics:
    """Statistics of a split.

    Parameters
    ----------
    data : Dataset
        A complete data set.
    split : str
        ``train`` or ``test``.

    Returns
    -------
    SplitStatistics

    Raises
    ------
    InputError
        A shard cannot be read.
    """
    found = SplitStatistics(data.estimates)
    for shard in data.shards(split):
        for arrays in blocks(shard.read()):
            found.add(arrays, data.lattice.finest)
    return found

"""Two Monte Carlo data sets at the same queries: do they estimate the same values?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.stats.estimate import Estimate, checked, mean_estimate
from mbtf_core.stats.groups import group_labels
from mbtf_core.stats.paired import mean_of_halves
from mbtf_core.stats.significance import holm, t_test

Kind = Literal["mean", "scatter"]

# Below this many independent units the t distribution of heavy-tailed noise is not trusted.
_MINIMUM = 1000


@dataclass(frozen=True)
class Comparison:
    """One tested aggregate.

    Attributes
    ----------
    group, channel : label of the group, and channel
    kind : {"mean", "scatter"}
        Mean difference, or mean squared true difference.
    estimate : the quantity, expected to be zero
    p_value : of this test alone
    corrected : corrected for the number of tests (Holm)
    """

    group: int
    channel: int
    kind: Kind
    estimate: Estimate
    p_value: float
    corrected: float


@dataclass(frozen=True)
class Aggregate:
    """All comparisons of :func:`aggregate_test`."""

    comparisons: tuple[Comparison, ...]

    @property
    def p_value(self) -> float:
        """Smallest corrected p-value: below α the data sets differ, with a false-alarm rate of at most α."""
        return min(c.corrected for c in self.comparisons)

    @property
    def worst(self) -> Comparison:
        """The comparison of the smallest p-value."""
        return min(self.comparisons, key=lambda c: c.p_value)

    def __str__(self) -> str:
        w = self.worst
        return (
            f"{len(self.comparisons)} comparisons, smallest corrected p = {self.p_value:.3g} "
            f"({w.kind} difference of group {w.group}, channel {w.channel}: {w.estimate})"
        )


def aggregate_test(
    a1: ArrayLike,
    b1: ArrayLike,
    a2: ArrayLike,
    b2: ArrayLike,
    groups: ArrayLike | None = None,
    *,
    minimum: int = _MINIMUM,
) -> Aggregate:
    """Compare two data sets at the same queries, by group and channel, corrected for the number of tests.

    Two aggregates are tested in each group and channel. The **mean** difference, with its error from the
    halves, finds a bias. The **scatter**, the mean of ``(a1-a2)(b1-b2)``, has the expectation ``(t1-t2)²``
    without noise and finds differences that average out, such as a shifted map; it is tested one-sided. Both
    are tested by Student's t with their own degrees of freedom. To test one data set against known values,
    give these as both `a2` and `b2`.

    Parameters
    ----------
    a1, b1 : (n, channels) or (items, rows, columns, channels) array_like
        Halves of the first data set.
    a2, b2 : halves of the second data set at the same queries, sampled independently
    groups : (n,) int array_like or None
        Labels; one group by default. Rows with negative labels are ignored.
    minimum : smallest number of units per group, below which heavy tails invalidate the t distribution

    Raises
    ------
    ValueError : shapes differ, there is no group, or a group has fewer than `minimum` units
    """
    arrays = [_channels(array, name) for array, name in ((a1, "a1"), (b1, "b1"), (a2, "a2"), (b2, "b2"))]
    if len({array.shape for array in arrays}) > 1:
        raise ValueError(f"the halves have different shapes: {', '.join(str(x.shape) for x in arrays)}")
    n, _, channels = arrays[0].shape
    labels = np.zeros(n, np.int64) if groups is None else group_labels(groups, n)
    found: list[tuple[int, int, Kind, Estimate, float]] = []
    for label in np.unique(labels[labels >= 0]):
        x1, y1, x2, y2 = (array[labels == label] for array in arrays)
        if len(x1) < minimum:
            raise ValueError(
                f"group {label} has {len(x1)} units, fewer than {minimum}: merge groups or lower `minimum`"
            )
        for c in range(channels):
            # The two noises add, each with its own degrees of freedom.
            mean = t_test(mean_of_halves(x1[..., c], y1[..., c]), mean_of_halves(x2[..., c], y2[..., c]))
            scatter = t_test(
                mean_estimate((x1[..., c] - x2[..., c]) * (y1[..., c] - y2[..., c])), 0.0, "greater"
            )
            found.append((int(label), c, "mean", mean.difference, mean.p_value))
            found.append((int(label), c, "scatter", scatter.difference, scatter.p_value))
    if not found:
        raise ValueError("no group to compare")
    corrected = holm([p for *_, p in found])
    return Aggregate(tuple(Comparison(*row, float(c)) for row, c in zip(found, corrected, strict=True)))


def _channels(array: ArrayLike, name: str) -> NDArray[np.float64]:
    """(n, texels, channels) of any accepted shape."""
    x = checked(array, name)
    return x.reshape(len(x), -1, x.shape[-1] if x.ndim > 1 else 1)

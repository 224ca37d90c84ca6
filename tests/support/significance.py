"""Tests of whole data sets against known values and each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.stats import Estimate, Outcome, mean_estimate, mean_of_halves, t_test
from mbtf_core.stats.estimate import checked, group_labels

Kind = Literal["mean", "scatter"]


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """p-values corrected for their number by Holm's step-down rule (1979). Any shape.

    Bounds the familywise error rate for any dependence between the tests; at least as powerful as Bonferroni.
    """
    p = np.asarray(p_values, np.float64)
    assert np.all((p >= 0) & (p <= 1))
    flat = p.ravel()
    order = np.argsort(flat, kind="stable")
    out = np.empty_like(flat)
    out[order] = np.minimum(np.maximum.accumulate(flat[order] * np.arange(flat.size, 0, -1)), 1.0)
    return out.reshape(p.shape)


@dataclass(frozen=True)
class Comparison:
    """One tested aggregate.

    Attributes
    ----------
    group, channel : label of the group, and channel
    kind : mean difference, or mean squared true difference
    estimate : the quantity, expected to be zero
    p_value, corrected : of this test alone, and corrected for the number of tests (Holm)
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
    minimum: int = 1000,
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
    """
    arrays = [checked(array, name) for array, name in ((a1, "a1"), (b1, "b1"), (a2, "a2"), (b2, "b2"))]
    assert len({array.shape for array in arrays}) == 1
    shape = arrays[0].shape
    arrays = [x.reshape(len(x), -1, shape[-1] if len(shape) > 1 else 1) for x in arrays]
    labels = np.zeros(shape[0], np.int64) if groups is None else group_labels(groups, shape[0])
    found: list[tuple[int, int, Kind, Outcome]] = []
    for label in np.unique(labels[labels >= 0]):
        halves = [array[labels == label] for array in arrays]
        assert len(halves[0]) >= minimum, f"group {label} has {len(halves[0])} units: merge groups"
        for c in range(halves[0].shape[-1]):
            x1, y1, x2, y2 = (half[..., c] for half in halves)
            # The two noises add, each with its own degrees of freedom.
            mean = t_test(mean_of_halves(x1, y1), mean_of_halves(x2, y2))
            scatter = t_test(mean_estimate((x1 - x2) * (y1 - y2)), 0.0, "greater")
            found += [(int(label), c, "mean", mean), (int(label), c, "scatter", scatter)]
    assert found
    corrected = holm([outcome.p_value for *_, outcome in found])
    return Aggregate(
        tuple(
            Comparison(label, c, kind, outcome.difference, outcome.p_value, float(p))
            for (label, c, kind, outcome), p in zip(found, corrected, strict=True)
        )
    )

"""How far chains scatter: what their error bars hold besides that of the test queries.

Another seed brings other data and other first weights. A few chains of one setting, judged by the same test
queries, show how much of an error is luck. It is in proportion to the error, so the standard deviation of the
errors' logarithms stands for all chains of as much data. Fits of few data scatter more than those of many,
because a few bright paths rule them, so it is measured at two sizes: between them the deviation is taken to
be linear in the size's logarithm, outside of them that of the nearer one.

The size is the number of queries times their paths, of which no more than those of the measured chains count:
where a query has more, queries are few, and luck is in where they lie; where it has fewer, in their noise.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost_study.measurements import Point

# Studies whose errors are those of fits.
FITTED = ("chain", "data", "fit", "seeds")
# Fewer values tell no deviation.
_FEWEST = 3


@dataclass(frozen=True)
class Scatter:
    """Relative standard deviation of the error over seeds.

    Attributes
    ----------
    spp : paths per query of the chains that it was measured on
    queries : their numbers of training queries, ascending; at least one
    deviations : at each of them
    """

    spp: int
    queries: tuple[float, ...]
    deviations: tuple[Estimate, ...]

    def of(self, point: Point) -> float:
        """Deviation of a chain."""
        size = _queries(point) * min(1.0, point.setting["queries.spp"] / self.spp)
        known = [e.value for e in self.deviations]
        return float(np.interp(math.log(size), np.log(self.queries), known))

    def describe(self) -> str:
        """``12 ± 5 % at 0.52 M queries × 4, 4 ± 2 % at 2.1 M × 4``."""
        pairs = zip(self.deviations, self.queries, strict=True)
        return ", ".join(
            f"{100 * e.value:.2g} ± {100 * e.error:.1g} % at {n / 1e6:.3g} M queries × {self.spp}"
            for e, n in pairs
        )


def _queries(point: Point) -> float:
    return float(point.setting["queries.train"])


def _deviation(values: Sequence[float]) -> Estimate:
    """Standard deviation of normal scatter, unbiased, from n values."""
    n = len(values)
    # That of a sample is low by this factor on average.
    low = math.sqrt(2 / (n - 1)) * math.gamma(n / 2) / math.gamma((n - 1) / 2)
    value = statistics.stdev(values) / low
    return Estimate(value, value / math.sqrt(2 * (n - 1)), n)


def seed_scatter(points: Sequence[Point]) -> Scatter | None:
    """Scatter over seeds; None where no setting was measured with three."""
    seeds = [p for p in points if p.study == "seeds"]
    settings = {_queries(p): {k: v for k, v in p.setting.items() if k != "seed"} for p in seeds}
    found = {}
    for queries, setting in sorted(settings.items()):
        like = [p for p in seeds if _queries(p) == queries]
        like += [p for p in points if p.study == "data" and p.setting == setting]
        logs = [math.log(p.error.value) for p in like if math.isfinite(p.error.value) and p.error.value > 0]
        if len(logs) >= _FEWEST:
            found[queries] = _deviation(logs)
    if not found:
        return None
    return Scatter(seeds[0].setting["queries.spp"], tuple(found), tuple(found.values()))


def mean_of(points: Sequence[Point]) -> Point:
    """Chains of one setting and several seeds as one point, that of the first with the means of all.

    They are judged by the same queries, so the bars that come from these do not become narrower.
    """

    def mean(estimates: Sequence[Estimate]) -> Estimate:
        value, error = (statistics.fmean(getattr(e, k) for e in estimates) for k in ("value", "error"))
        return replace(estimates[0], value=value, error=error)

    details = {k: statistics.fmean(p.details[k] for p in points) for k in points[0].details}
    return replace(
        points[0],
        seconds=mean([p.seconds for p in points]),
        error=mean([p.error for p in points]),
        details={**details, "seeds": float(len(points))},
    )


def bar_of(points: Sequence[Point], scatter: Scatter) -> float:
    """Standard error of the mean of a chain's seeds.

    It holds the error of the test queries, and over the square root of their number the deviation between
    seeds: that of chains of as much data, or of these ones where it is larger.
    """
    mean = mean_of(points)
    deviation = scatter.of(mean)
    logs = [math.log(p.error.value) for p in points if p.error.value > 0]
    if len(logs) >= _FEWEST:
        deviation = max(deviation, _deviation(logs).value)
    return math.hypot(mean.error.error, deviation * mean.error.value / math.sqrt(len(points)))


def with_scatter(
    points: Sequence[Point], scatter: Scatter | None, again: Mapping[int, Sequence[Point]] | None = None
) -> list[Point]:
    """The points with the scatter of seeds in the error bars of chains, in quadrature.

    Parameters
    ----------
    again : of some, by their place, the same chain with other seeds: their means are given
    """
    if scatter is None:
        return list(points)
    out = []
    for place, p in enumerate(points):
        if p.study in FITTED:
            seeds = [p, *(again or {}).get(place, ())]
            p = mean_of(seeds)
            p = replace(p, error=replace(p.error, error=bar_of(seeds, scatter)))
        out.append(p)
    return out

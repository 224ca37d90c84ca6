"""The Pareto front: settings that nothing beats in both time and error."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost_study.measurements import Point

# The front's end: points of at least this share of the last one's seconds, and at least so many.
_LATE, _FEWEST = 0.25, 3
# Relative error below which no bar is believed.
_BEST_KNOWN = 1e-3
# Times the last point's seconds beyond which nothing is said.
_LONGEST = 1000.0


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Points that no other is both cheaper than and more accurate than, by rising seconds.

    Judged by the measured values; of points whose error bars overlap the cheaper one may be on the front by
    chance, which the bars show.
    """
    usable = [p for p in points if math.isfinite(p.seconds.value) and math.isfinite(p.error.value)]
    front: list[Point] = []
    for point in sorted(usable, key=lambda p: (p.seconds.value, p.error.value)):
        if not front or point.error.value < front[-1].error.value:
            front.append(point)
    return front


def marginal_price(front: Sequence[Point], factor: float = 2.0) -> tuple[float, Estimate] | None:
    """(seconds, exponent): what dividing the error of the front's last point by `factor` would take on top,
    and the power of time that the error falls with at the front's end.

    From a line through the logarithms of those points that take a quarter of the last one's seconds or more,
    at least three, weighted by their error bars. Errors fall ever more slowly, so in truth it takes longer.
    None where there are fewer, the power is not told from zero, or a thousand times as long would not do.
    """
    usable = [p for p in front if p.error.value > 0 and math.isfinite(p.error.error)]
    late = [p for p in usable if p.seconds.value >= _LATE * front[-1].seconds.value]
    some = late if len(late) >= _FEWEST else usable[-_FEWEST:]
    if len(some) < _FEWEST:
        return None
    line = weighted_line(
        [math.log(p.seconds.value) for p in some],
        [math.log(p.error.value) for p in some],
        [max(p.error.relative_error, _BEST_KNOWN) for p in some],
    )
    if line is None or -line.value <= max(2.0 * line.error, math.log(factor) / math.log(_LONGEST)):
        return None
    return front[-1].seconds.value * (factor ** (-1.0 / line.value) - 1.0), line.scaled(-1.0)


def weighted_line(xs: Sequence[float], ys: Sequence[float], errors: Sequence[float]) -> Estimate | None:
    """Slope of the line through points whose heights have these standard errors, all above zero, and its own;
    None where all lie at one place."""
    weights = [1 / e**2 for e in errors]
    total = sum(weights)
    mean_x, mean_y = (sum(w * v for w, v in zip(weights, vs, strict=True)) / total for vs in (xs, ys))
    spread = sum(w * (x - mean_x) ** 2 for w, x in zip(weights, xs, strict=True))
    if not spread > 0:
        return None
    slope = sum(w * (x - mean_x) * (y - mean_y) for w, x, y in zip(weights, xs, ys, strict=True)) / spread
    return Estimate(slope, math.sqrt(1 / spread), len(xs))

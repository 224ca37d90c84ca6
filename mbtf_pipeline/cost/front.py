"""The Pareto front: settings that nothing beats in both time and error."""

from __future__ import annotations

import math
from collections.abc import Sequence

from .points import Point


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


def marginal_price(front: Sequence[Point], factor: float = 2.0) -> tuple[float, float] | None:
    """(seconds, exponent): what dividing the error of the front's last point by `factor` would take on top,
    and the power of time that the error falls with, from a line through the front's logarithms.

    None where the front has fewer than three points, or does not fall.
    """
    if len(front) < 3:
        return None
    xs = [math.log(p.seconds.value) for p in front if p.error.value > 0]
    ys = [math.log(p.error.value) for p in front if p.error.value > 0]
    if len(xs) < 3:
        return None
    mean_x, mean_y = sum(xs) / len(xs), sum(ys) / len(ys)
    spread = sum((x - mean_x) ** 2 for x in xs)
    slope = sum((x - mean_x) * (y - mean_y) for x, y in zip(xs, ys, strict=True)) / spread if spread else 0.0
    if slope >= 0:
        return None
    last = front[-1].seconds.value
    return last * (factor ** (-1.0 / slope) - 1.0), -slope

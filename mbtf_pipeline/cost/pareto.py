"""The Pareto front: measurements that no other one beats in both time and error."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost.measurements import Measurement

# The extrapolation uses so many points of the front, and never goes further than so many times the seconds
# of the last one.
_POINTS = 3
_FURTHEST = 1000.0
# Relative errors are taken to be known no better than this.
_BEST_KNOWN = 1e-3


def pareto_front(found: Sequence[Measurement]) -> list[Measurement]:
    """Measurements that no other one beats in both time and error, by increasing time.

    Compares the measured values. Of measurements whose error bars overlap, the cheaper one may be on the
    front by chance.
    """
    usable = [m for m in found if math.isfinite(m.seconds.value) and math.isfinite(m.error.value)]
    front: list[Measurement] = []
    for m in sorted(usable, key=lambda m: (m.seconds.value, m.error.value)):
        if not front or m.error.value < front[-1].error.value:
            front.append(m)
    return front


def extrapolation(front: Sequence[Measurement]) -> tuple[float, Estimate] | None:
    """(seconds, exponent): the additional time that would halve the error of the front's last point, and the
    power of time with which the error falls, from a power law through the last three points.

    None where there are fewer, where the exponent is not significant, or where the result is too far away.
    """
    last = [m for m in front if m.error.value > 0 and math.isfinite(m.error.error)][-_POINTS:]
    if len(last) < _POINTS:
        return None
    x, y = np.log([m.seconds.value for m in last]), np.log([m.error.value for m in last])
    weights = [1.0 / max(m.error.relative_error, _BEST_KNOWN) for m in last]
    (slope, _), covariance = np.polyfit(x, y, 1, w=weights, cov="unscaled")
    power = Estimate(-float(slope), math.sqrt(covariance[0, 0]), len(last))
    if power.value <= max(2.0 * power.error, math.log(2.0) / math.log(_FURTHEST)):
        return None
    return front[-1].seconds.value * (2.0 ** (1.0 / power.value) - 1.0), power

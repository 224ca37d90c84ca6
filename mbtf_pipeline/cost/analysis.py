"""What follows from measurements: error bars of runs from their seeds, and the Pareto front.

Another seed generates other data and another test set, and starts from other weights. A configuration that
was run n times is reported with the mean of its errors, and the standard error s / √n. The relative standard
deviation s is pooled over all repeated configurations, so two runs of each are enough. It is no less than the
error of the test set: all runs of a seed share it, so few seeds can miss it.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mbtf_core.stats import Estimate, mean_estimate
from mbtf_pipeline.cost.measurement import Measurement

# The extrapolation uses so many points of the front, and never goes further than so many times the seconds
# of the last one.
_POINTS = 3
_FURTHEST = 1000.0
# Relative errors are taken to be known no better than this.
_BEST_KNOWN = 1e-3


def seed_deviation(groups: Sequence[Sequence[Measurement]]) -> Estimate | None:
    """Relative standard deviation of the error over seeds, pooled over configurations with their degrees of
    freedom; each group holds the runs of one configuration. None without any repeat."""
    squares, dof = 0.0, 0
    for group in groups:
        errors = [m.error.value for m in group if m.error.value > 0]
        if len(errors) > 1:
            squares += (len(errors) - 1) * statistics.variance(errors) / statistics.fmean(errors) ** 2
            dof += len(errors) - 1
    if dof == 0:
        return None
    value = math.sqrt(squares / dof)
    return Estimate(value, value / math.sqrt(2 * dof), dof)


def combined(group: Sequence[Measurement], deviation: Estimate | None) -> Measurement:
    """The runs of one configuration as one measurement: name and command of the first one, means of all."""
    error = statistics.fmean(m.error.value for m in group)
    spread = 0.0 if deviation is None else deviation.value * error
    test = math.sqrt(statistics.fmean(m.error.error**2 for m in group))
    details = {k: statistics.fmean(m.details[k] for m in group) for k in group[0].details}
    return replace(
        group[0],
        seconds=mean_estimate([m.seconds.value for m in group]),
        error=Estimate(error, max(spread, test) / math.sqrt(len(group)), group[0].error.n),
        details={**details, "seeds": float(len(group))},
    )


def pareto_front(found: Sequence[Measurement]) -> list[Measurement]:
    """Complete runs that no other one beats in both time and error, by increasing time.

    Compares the measured values. Of measurements whose error bars overlap, the cheaper one may be on the
    front by chance.
    """
    runs = [m for m in found if m.study == "run"]
    usable = [m for m in runs if math.isfinite(m.seconds.value) and math.isfinite(m.error.value)]
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

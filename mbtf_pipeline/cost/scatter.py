"""How far fits of other seeds scatter: what the error bars of chains hold besides that of the test queries.

Chains of a study share their test queries, so a few fits of one setting, on the same data and with other
seeds, show how much of a difference between two chains is luck. Errors of fits scatter in proportion to
themselves, so the standard deviation of their logarithms, measured on the shortest fit, stands for all.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import replace

from mbtf_gen.stats import Estimate

from .points import Point

# Studies whose errors are those of fits.
FITTED = ("chain", "data", "fit", "seeds")


def seed_scatter(points: Sequence[Point]) -> Estimate | None:
    """Relative standard deviation of the error over seeds; None where fewer than three were measured."""
    seeds = [p for p in points if p.study == "seeds"]
    if not seeds:
        return None
    like = {k: v for k, v in seeds[0].setting.items() if k != "seed"}
    errors = [p.error.value for p in seeds]
    errors += [p.error.value for p in points if p.study == "fit" and p.setting == like]
    logs = [math.log(e) for e in errors if math.isfinite(e) and e > 0]
    if len(logs) < 3:
        return None
    deviation = statistics.stdev(logs)
    # Of a standard deviation, for normal scatter.
    return Estimate(deviation, deviation / math.sqrt(2 * (len(logs) - 1)), len(logs))


def with_scatter(points: Sequence[Point]) -> list[Point]:
    """The points with the scatter of seeds in the error bars of fits, in quadrature."""
    scatter = seed_scatter(points)
    if scatter is None:
        return list(points)
    out = []
    for p in points:
        if p.study in FITTED:
            bar = math.hypot(p.error.error, scatter.value * p.error.value)
            p = replace(p, error=replace(p.error, error=bar))
        out.append(p)
    return out

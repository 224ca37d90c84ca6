r"""Paths of a shard's queries: a mean number of them, or as many as a target error takes.

Under a target ε every query first gets a pilot of its own, with random numbers of its own, that is thrown
away. The variance of one path is taken from the sample variance V of the pilot's ν + 1 paths and what the
run's allocation expects of such a query, s²:

    v = (ν V + ν₀ c² s²) / (ν + ν₀)

so that a pilot that happened to miss a few bright paths does not stop the query at once. The expectation
follows large variances; what counts here is variance relative to the square of the tile mean. So the pilots
of all of the shard's queries say by how much s² falls short in that sense: c² is the ratio of the means of
both, never below one. From v follow the paths that bring the standard error to ε · max(value, tile mean),
rounded up, and at most the cap. The value is the pilot's, drawn towards the tile mean as far as its own
error leaves the difference in doubt (James and Stein 1961): a pilot with one bright path would otherwise
allow the query a greater error for it. The counts depend on the pilot alone, and the stored paths are drawn
afresh: values are unbiased, their halves are independent. Stopping when the paths drawn so far look good
enough would be neither: it stops early where they missed the light. A second, longer look at queries that
seem to need many paths was tried and did not pay: most of what is missed is missed by queries that seem to
need few.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.planning.sample_allocation import FEWEST
from mbtf_gen.render.estimates import Estimates, Stream, TargetReached
from mbtf_gen.sampling.query_sampler import Queries

if TYPE_CHECKING:
    from mbtf_gen.planning.effects import EffectsPlan

F64 = NDArray[np.float64]

# Paths of a query's own pilot, and how many paths the run's expectation counts for beside it.
PILOT_SPP = 16
PRIOR_PATHS = 16
# The expectation is raised to what the shard's pilots say, at most to twice the deviation: the median of so
# many groups of them, lest a single bright path decide, if each has at least so many queries.
MOST_CORRECTION = 2.0
GROUPS, FEWEST_IN_GROUP = 8, 16
# A value's excess over the tile mean shrinks by this many of its squared standard errors: as many as leave
# nothing of an excess that one path of the pilot brought, whose squared error is its square over this.
DOUBT = (PILOT_SPP - 1 + PRIOR_PATHS) / (PILOT_SPP - 1)
# Pilots draw in these passes, which the stored paths never reach.
PILOT_PASS = 1024


@dataclass(frozen=True)
class Target:
    """Standard error of every value to reach, relative to max(value, tile mean), with at most `cap` paths."""

    error: float
    cap: int


def estimate_shard(
    estimator: Any, queries: Queries, spp: int, target: Target | None, stream: Stream, effects: EffectsPlan
) -> Estimates:
    """Both halves of a shard's queries (one leading axis).

    Parameters
    ----------
    spp : mean number of paths where there is no target
    effects : the run's plan, with its allocation
    """
    allocation = effects.allocation
    found: Estimates
    if effects.closed_form or allocation is None:
        found = estimator.estimate(queries, spp, stream)
        return found
    if target is None:
        found = estimator.estimate(queries, allocation.counts(queries, spp), stream)
        return found
    pilot = estimator.estimate(queries, PILOT_SPP, replace(stream, first_pass=PILOT_PASS), path_variance=True)
    expected = allocation.deviation(queries), allocation.tile_mean(queries)
    wanted, scale = wanted_paths(pilot, PILOT_SPP, *expected, target.error)
    counts = round_up(np.minimum(wanted, target.cap), target.cap)
    found = estimator.estimate(queries, counts, stream)
    return replace(
        found,
        paths=found.paths + pilot.paths,
        lost=found.lost + pilot.lost,
        capped=found.capped + pilot.capped,
        nonfinite=found.nonfinite + pilot.nonfinite,
        target=_reached(found, wanted, scale, target),
    )


def wanted_paths(
    pilot: Estimates, paths: int, deviation: F64, tile_mean: F64, error: float
) -> tuple[F64, F64]:
    """Paths (n,) that queries need for a relative error, after a pilot of `paths` each, and the value (n,),
    1/sr, that the error is relative to: no less than the tile mean.

    Parameters
    ----------
    deviation, tile_mean : (n,) what the run's allocation expects
    """
    assert pilot.path_variance is not None
    own, seen = paths - 1, pilot.path_variance.astype(np.float64)
    expected = (correction(seen, deviation, tile_mean) * deviation) ** 2
    variance = (own * seen + PRIOR_PATHS * expected) / (own + PRIOR_PATHS)
    excess = np.maximum(_values(pilot) - tile_mean, 0.0)
    doubt = np.divide(DOUBT * variance / paths, excess, out=np.zeros(len(excess)), where=excess > 0)
    scale = tile_mean + np.maximum(excess - doubt, 0.0)
    allowed = error * scale
    return np.divide(variance, allowed**2, out=np.zeros(len(variance)), where=allowed > 0), scale


def correction(variance: F64, deviation: F64, tile_mean: F64) -> float:
    """Factor on the expected deviations, from 1 to :data:`MOST_CORRECTION`: the root of what pilots found of
    the variance relative to the tile mean's square over what was expected of it.

    Parameters
    ----------
    variance : (n,) sample variances of the pilots' paths
    deviation, tile_mean : (n,) what the run's allocation expects
    """
    if len(variance) < GROUPS * FEWEST_IN_GROUP:
        return 1.0
    square = np.where(tile_mean > 0, tile_mean, np.inf) ** 2
    found, expected = variance / square, deviation**2 / square
    ratios = sorted(
        # Sums that no processor rounds otherwise.
        math.fsum(found[g::GROUPS]) / max(math.fsum(expected[g::GROUPS]), 1e-300)
        for g in range(GROUPS)
    )
    middle = 0.5 * (ratios[GROUPS // 2 - 1] + ratios[GROUPS // 2])
    return min(max(math.sqrt(middle), 1.0), MOST_CORRECTION)


def _values(estimates: Estimates) -> F64:
    """Mean over channels and halves (n,)."""
    return 0.5 * np.mean(estimates.value_a.astype(np.float64) + estimates.value_b, axis=-1)


def round_up(wanted: F64, cap: int) -> NDArray[np.int64]:
    """The next number of paths that is a power of two or three times one, which fill nets of points, from
    ``FEWEST`` to `cap`."""
    fraction, power = np.frexp(np.maximum(wanted, FEWEST))
    power = np.where(fraction == 0.5, power - 1, power)
    whole = np.ldexp(1.0, power)
    # 1.5 halves of a net: even, so that both halves have the same.
    between = np.where(power >= 3, 0.75 * whole, whole)
    return np.minimum(np.where(wanted <= between, between, whole), cap).astype(np.int64)


def _reached(found: Estimates, wanted: F64, scale: F64, target: Target) -> TargetReached:
    # Over values that the stored paths do not enter: a bright path among them would divide its own error.
    missed = wanted > target.cap
    error = np.mean((0.5 * (found.value_a.astype(np.float64) - found.value_b)) ** 2, axis=-1)
    relative = np.divide(error, scale**2, out=np.zeros(len(error)), where=scale > 0)
    worst = target.error * float(np.sqrt(wanted.max() / target.cap)) if missed.any() else 0.0
    return TargetReached(len(wanted), int(missed.sum()), worst, float(relative.mean()))

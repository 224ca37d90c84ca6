r"""Paths of a shard's queries: a mean number, or as many as a target error requires.

Under a target error ε every query first gets its own pilot, with its own random numbers, which is discarded.
The variance of one path combines the sample variance V of the pilot's ν + 1 paths with s², the variance that
the run's allocation predicts for such a query:

    v = (ν V + ν₀ c² s²) / (ν + ν₀)

so that a query does not stop at once because its pilot missed a few bright paths. The prediction follows
large variances, but the target concerns the variance relative to the squared tile mean. The pilots of all
queries of the shard therefore estimate by how much s² is too small in that sense: c² is the ratio of both
means, at least one. The number of paths brings the standard error to ε · max(value, tile mean), is rounded
up, and is limited by a cap. The value is the pilot's, shrunk toward the tile mean as far as the pilot's error
leaves the difference uncertain (James and Stein 1961). Otherwise one bright path in the pilot would allow the
query a larger error.

The counts depend on the pilot alone, and the stored paths are sampled afresh: values are unbiased and their
halves independent. A rule that stops when the paths so far agree well enough would be biased: it stops early
when they missed the light. A second, longer pilot for queries that seem to need many paths did not pay,
because most errors above the target occur in queries that seem to need few.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.documents import TargetReached
from mbtf_core.data.schema import Queries
from mbtf_gen.planning.sample_allocation import FEWEST, Allocation, mean_values
from mbtf_gen.render.estimates import TARGET_PILOT_SPP, Estimates, Stream, Target

F64 = NDArray[np.float64]

# Weight of the run's prediction beside the query's own pilot, as a number of paths (ν₀).
PRIOR_PATHS = 16
# The predicted deviation is raised to that of the shard's pilots, at most by this factor: by the median over
# so many groups, so that no single bright path decides, if each group has at least so many queries.
MOST_CORRECTION = 2.0
GROUPS, FEWEST_IN_GROUP = 8, 16
# A value's excess over the tile mean shrinks by this many of its squared standard errors over the excess. An
# excess that a single path of the pilot causes shrinks to zero.
DOUBT = (TARGET_PILOT_SPP - 1 + PRIOR_PATHS) / (TARGET_PILOT_SPP - 1)
# Pilots use these passes of the random numbers, which the stored paths never reach.
PILOT_PASS = 1024


def estimate_shard(
    estimator: Any,
    queries: Queries,
    spp: int,
    target: Target | None,
    stream: Stream,
    allocation: Allocation | None,
    lights: int = 1,
) -> Estimates:
    """Both halves of a shard's queries (one leading axis).

    Parameters
    ----------
    spp : mean number of paths without a target
    allocation : the run's allocation; without one all queries get `spp` paths
    lights : queries of a group that share their paths, see
        :meth:`~mbtf_gen.render.estimator.Estimator.estimate`; a target error holds for each of them
    """
    found: Estimates
    if allocation is None or target is None:
        planned = spp if allocation is None else allocation.counts(queries, spp, lights)
        found = estimator.estimate(queries, planned, stream, lights=lights)
        return found
    pilot_stream = replace(stream, first_pass=PILOT_PASS)
    pilot = estimator.estimate(queries, TARGET_PILOT_SPP, pilot_stream, path_variance=True, lights=lights)
    predicted = allocation.deviation(queries), allocation.tile_mean(queries)
    needed, scale = needed_paths(pilot, TARGET_PILOT_SPP, *predicted, target.error)
    needed = np.tile(needed.reshape(lights, -1).max(axis=0), lights)
    counts = round_up(np.minimum(needed, target.max_spp), target.max_spp)
    found = estimator.estimate(queries, counts, stream, lights=lights)
    return replace(
        found,
        **{k: getattr(found, k) + getattr(pilot, k) for k in ("paths", "lost", "capped", "nonfinite")},
        target=_reached(found, needed, scale, target),
    )


def needed_paths(
    pilot: Estimates, paths: int, deviation: F64, tile_mean: F64, error: float
) -> tuple[F64, F64]:
    """Paths (n,) that queries need for a relative error, from a pilot of `paths` each and the deviation and
    tile mean (n,) that the run's allocation predicts; and the value (n,), 1/sr, that the error is relative
    to: at least the tile mean."""
    assert pilot.path_variance is not None
    own, seen = paths - 1, pilot.path_variance.astype(np.float64)
    expected = (correction(seen, deviation, tile_mean) * deviation) ** 2
    variance = (own * seen + PRIOR_PATHS * expected) / (own + PRIOR_PATHS)
    excess = np.maximum(mean_values(pilot) - tile_mean, 0.0)
    doubt = np.divide(DOUBT * variance / paths, excess, out=np.zeros(len(excess)), where=excess > 0)
    scale = tile_mean + np.maximum(excess - doubt, 0.0)
    allowed = error * scale
    return np.divide(variance, allowed**2, out=np.zeros(len(variance)), where=allowed > 0), scale


def correction(variance: F64, deviation: F64, tile_mean: F64) -> float:
    """Factor c on the predicted deviations (n,), from 1 to :data:`MOST_CORRECTION`: the root of the ratio of
    the pilots' sample variance (n,) to the predicted one, both relative to the squared tile mean."""
    if len(variance) < GROUPS * FEWEST_IN_GROUP:
        return 1.0
    square = np.where(tile_mean > 0, tile_mean, np.inf) ** 2
    found, expected = variance / square, deviation**2 / square
    ratios = sorted(
        # Exactly rounded sums, the same on every processor.
        math.fsum(found[g::GROUPS]) / max(math.fsum(expected[g::GROUPS]), 1e-300)
        for g in range(GROUPS)
    )
    middle = 0.5 * (ratios[GROUPS // 2 - 1] + ratios[GROUPS // 2])
    return min(max(math.sqrt(middle), 1.0), MOST_CORRECTION)


def round_up(needed: F64, cap: int) -> NDArray[np.int64]:
    """The next number of paths that completes a net of points, a power of two or three times one, from
    ``FEWEST`` to `cap`."""
    fraction, power = np.frexp(np.maximum(needed, FEWEST))
    power = np.where(fraction == 0.5, power - 1, power)
    whole = np.ldexp(1.0, power)
    # 1.5 times half a net; even, so that both halves get the same number.
    between = np.where(power >= 3, 0.75 * whole, whole)
    return np.minimum(np.where(needed <= between, between, whole), cap).astype(np.int64)


def _reached(found: Estimates, needed: F64, scale: F64, target: Target) -> TargetReached:
    # Relative to values from the pilot: a bright path among the stored ones would divide its own error.
    missed = needed > target.max_spp
    error = np.mean((0.5 * (found.value_a.astype(np.float64) - found.value_b)) ** 2, axis=-1)
    relative = np.divide(error, scale**2, out=np.zeros(len(error)), where=scale > 0)
    worst = target.error * float(np.sqrt(needed.max() / target.max_spp)) if missed.any() else 0.0
    return TargetReached(len(needed), int(missed.sum()), worst, float(relative.mean()))

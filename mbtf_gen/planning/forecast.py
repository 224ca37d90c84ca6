"""Forecast of the time, disk space and noise of a data set, from a pilot on this machine."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mbtf_core.data.shard_files import write_shard
from mbtf_core.stats import Estimate, pooled_error
from mbtf_core.units import clock, rate_text, size_text
from mbtf_gen.planning.adaptive import estimate_shard
from mbtf_gen.planning.job import (
    Job,
    data_bytes,
    path_work,
    split_lights,
    split_queries,
    split_spp,
    split_target,
)
from mbtf_gen.planning.run_plan import RunPlan, allocate, plan_effects
from mbtf_gen.planning.simulation import build_estimator, pilot_queries
from mbtf_gen.render.estimates import Estimates, Stream, Target

_HALVES = ("value_a", "value_b")
# Paths of one piece of the pilot at most, and of the first pieces, which compile the kernels and measure the
# speed; the time that a piece may take.
_PIECE_PATHS, _FIRST_PATHS, _PIECE_SECONDS = 1 << 19, 1 << 13, 0.5
# Relative error of a predicted noise from which it is stated; a pilot without highlights has a tenth of it.
_UNCERTAIN = 0.02
# Fewest timed pieces of a pilot.
_FEWEST_PIECES = 3


@dataclass(frozen=True)
class Forecast:
    """Prediction for a data set.

    Attributes
    ----------
    seconds, seconds_se : of sampling, tracing and writing all queries with compiled kernels, and the standard
        error
    start : seconds of loading, compiling and the pilot's first piece
    paths : of all splits, including the queries' own pilots under a target error
    paths_per_query : mean over the training split, without pilots
    bytes : of all shards
    relative_error, relative_error_se : RMS noise of one training value relative to the mean value, as in a
        run's summary, and its standard error
    """

    seconds: float
    seconds_se: float
    start: float
    paths: int
    paths_per_query: float
    bytes: int
    relative_error: float
    relative_error_se: float

    def describe(self, target: Target | None = None) -> str:
        """One line, two under a target error."""
        total = self.start + self.seconds
        error = f" ± {clock(self.seconds_se)}" if self.seconds_se >= 0.5 else ""
        noise = f"{self.relative_error:.0%} of the mean value"
        # Most of the variance of highlights is that of few queries, which a pilot may miss.
        if self.relative_error_se > _UNCERTAIN * self.relative_error:
            noise += f", ± {self.relative_error_se:.0%} or more: few queries decide it"
        line = (
            f"forecast: {clock(total)}{error}, "
            f"{rate_text(self.paths / max(total, 1e-9))} ({self.start:.0f} s of startup included), "
            f"{size_text(self.bytes)}, noise of one training value {noise}"
        )
        if target is None:
            return line
        return (
            f"{line}\n  {self.paths_per_query:.0f} paths per training query for an error of "
            f"{target.error:.2%} of max(value, tile mean)"
        )


def forecast(job: Job, plan: RunPlan | None = None, seconds: float = 2.0) -> Forecast:
    """Trace a small part of the training split and extrapolate.

    Parameters
    ----------
    job, plan : the run; by default with the plan that needs no pilots
    seconds : time of the pilot at most, after its first pieces
    """
    plan = plan or allocate(job, plan_effects(job, pilots=False))
    began = time.perf_counter()
    estimator = build_estimator(job, plan.effects)
    spp, target = split_spp(job.config, "train"), split_target(job.config, "train")
    count, test_paths = split_queries(job, "train"), split_queries(job, "test") * job.config.queries.test_spp
    lights = split_lights(job.config, "train")
    size = max(1, _FIRST_PATHS // (spp if target is None else target.max_spp))
    # A piece is at most the work of the run, in training queries; a test set alone has one of these.
    most = max(count // lights, test_paths // spp)
    found: list[Estimates] = []

    def stored(estimates: Estimates) -> int:
        spent = spp * len(estimates.value_a) if estimates.spp is None else int(estimates.spp.sum())
        return spent // lights

    def piece(number: int) -> int:
        """Estimate and write some queries as in the run; returns their paths."""
        queries = pilot_queries(job, lights * max(1, min(size, most)), number, lights)
        stream = Stream(job.config.seed, "pilot", number)
        found.append(estimate_shard(estimator, queries, spp, target, stream, plan.allocation, lights))
        arrays = vars(queries) | {name: getattr(found[-1], name) for name in _HALVES}
        with tempfile.TemporaryDirectory(prefix="mbtf-forecast-") as folder:
            write_shard(Path(folder) / "piece.npz", arrays)
        return max(found[-1].paths, stored(found[-1]))

    # Piece 0 compiles the kernels. Under a target error it traces fewer paths than the cap allows.
    piece(0)
    warm = time.perf_counter()
    first = piece(1)
    start = time.perf_counter() - began
    affordable = _PIECE_SECONDS * first / max(time.perf_counter() - warm, 1e-9)
    paths_of_query = max(first, 1) / len(found[1].value_a)
    size = max(1, round(min(_PIECE_PATHS, affordable) / (lights * paths_of_query)))
    found.clear()
    path = pilot_seconds(lambda number: piece(number + 1), seconds)
    a, b = (np.concatenate([getattr(one, name) for one in found]) for name in _HALVES)
    per_query = sum(max(one.paths, stored(one)) for one in found) / len(a)
    paths = round(count * per_query) + test_paths
    total = path.scaled(count * per_query + test_paths / path_work(lights))
    mean = 0.5 * float(np.mean(a, dtype=np.float64) + np.mean(b, dtype=np.float64))
    # Queries of a group are one unit: their errors are correlated.
    by_group = (
        np.concatenate([getattr(one, name).reshape(lights, -1, 3).swapaxes(0, 1) for one in found])
        for name in _HALVES
    )
    error = pooled_error(*by_group).scaled(1.0 / mean if mean > 0 else 0.0)
    return Forecast(
        seconds=total.value,
        seconds_se=total.error,
        start=start,
        paths=paths,
        paths_per_query=lights * sum(map(stored, found)) / len(a),
        bytes=data_bytes(job, job.shards),
        relative_error=error.value,
        relative_error_se=error.error,
    )


def pilot_seconds(piece: Callable[[int], float], seconds: float) -> Estimate:
    """Seconds of one unit of work: the median over timed pieces of it, for so many seconds and three at
    least. ``piece(number)``, from 1, does a piece and returns how many units of work it was."""
    times: list[float] = []
    began = time.perf_counter()
    while len(times) < _FEWEST_PIECES or time.perf_counter() - began < seconds:
        start = time.perf_counter()
        units = piece(len(times) + 1)
        times.append(max(time.perf_counter() - start, 1e-9) / units)
    return median_estimate(times)


def median_estimate(times: Sequence[float]) -> Estimate:
    """Median of timings in seconds, which other work on the machine changes little. Its standard error
    follows from the median absolute deviation, as for a normal distribution."""
    middle = float(np.median(times))
    deviation = 1.4826 * float(np.median(np.abs(np.asarray(times) - middle)))
    return Estimate(middle, 1.2533 * deviation / math.sqrt(len(times)), len(times))

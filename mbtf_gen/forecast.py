"""Forecast of the time, disk space and noise of a run, from a pilot on this machine."""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.app.console import Console
from mbtf_core.data.queries import Queries
from mbtf_core.data.schema import ShardEntry, Split
from mbtf_core.data.shard_files import row_bytes, write_shard
from mbtf_core.stats import pooled_error
from mbtf_core.units import clock, expectation, size_text
from mbtf_gen.job import Job, most_paths, planned_paths, split_queries, split_spp, split_target
from mbtf_gen.planning.adaptive import estimate_shard
from mbtf_gen.planning.pilot import pilot_queries
from mbtf_gen.planning.run_plan import RunPlan
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream, Target

# Paths of one piece of the pilot, and the minimum number of timed pieces.
_PIECE_PATHS = 1 << 19
_FEWEST = 3
# Fewer paths take less than a minute at half a million paths per second.
LONG_RUN = 30_000_000


@dataclass(frozen=True)
class Forecast:
    """Prediction for a run.

    Attributes
    ----------
    seconds : float
        Of tracing with compiled kernels, and of sampling queries and writing shards.
    start : float
        Seconds of loading, compiling and the pilot's first piece.
    query_seconds : float
        Total seconds per training query.
    paths : int
        Of all splits, including the queries' own pilots under a target error.
    paths_per_second : float
        Paths of both halves over all seconds of the run, startup included, as in a run's summary.
    paths_per_query : float
        Mean over the training split, without pilots.
    missed : float
        Share of training queries that miss the target error because of the cap on paths; 0 without a target.
    bytes : int
        Of all shards.
    relative_error : float
        RMS noise of one training value relative to the mean value, as in a run's summary.
    relative_error_se : float
        Its standard error.
    pilot_seconds : float
        Duration of the forecast.
    """

    seconds: float
    start: float
    query_seconds: float
    paths: int
    paths_per_second: float
    paths_per_query: float
    missed: float
    bytes: int
    relative_error: float
    relative_error_se: float
    pilot_seconds: float

    def describe(self, target: Target | None = None) -> str:
        """One line, two under a target error."""
        line = (
            f"forecast: {clock(self.start + self.seconds)}, {self.paths_per_second / 1e6:.2f} M paths/s "
            f"({self.start:.0f} s of startup included), {size_text(self.bytes)}, noise of one training value "
            f"{self.relative_error:.0%} of the mean value"
        )
        if target is None:
            return line
        line += (
            f"\n  {self.paths_per_query:.0f} paths per training query for an error of {target.error:.2%} of "
            "max(value, tile mean)"
        )
        if self.missed:
            line += f"; {self.missed:.1%} of the queries stop at the cap of {target.max_spp}"
        return line


@dataclass(frozen=True)
class _Piece:
    """One piece of a pilot: queries, paths in total and those of stored values, queries that missed a target,
    seconds of tracing, seconds of sampling queries and writing, both halves."""

    queries: int
    paths: int
    stored: int
    missed: int
    seconds: float
    beside: float
    value_a: NDArray[np.float32]
    value_b: NDArray[np.float32]


def forecast(job: Job, plan: RunPlan, seconds: float = 2.0) -> Forecast:
    """Trace a small part of each split and extrapolate.

    Parameters
    ----------
    job : Job
        The run.
    plan : RunPlan
        Its plan.
    seconds : float
        Time spent on the training split at most, after the first pieces.

    Returns
    -------
    Forecast
    """
    began = time.perf_counter()
    estimator = build_estimator(job, plan.effects)
    target = split_target(job.config, "train")
    first_spp = split_spp(job.config, "train") if target is None else target.max_spp
    first = _piece(job, plan, estimator, "train", 0, _PIECE_PATHS // first_spp)
    start = time.perf_counter() - began
    # Under a target error the first piece has traced fewer paths.
    size = max(1, _PIECE_PATHS * first.queries // max(first.paths, 1))
    train = _pilot(job, plan, estimator, "train", seconds, size)
    a, b = (np.concatenate([getattr(p, name) for p in train]) for name in ("value_a", "value_b"))
    mean = 0.5 * float(np.mean(a, dtype=np.float64) + np.mean(b, dtype=np.float64))
    error = pooled_error(a, b).scaled(1.0 / mean if mean > 0 else 0.0)
    traced, count = sum(p.queries for p in train), split_queries(job, "train")
    paths = round(count * sum(p.paths for p in train) / traced)
    each = _query_seconds(train)
    total = each * count
    test_spp, test_count = split_spp(job.config, "test"), split_queries(job, "test")
    if test_count:
        part = _pilot(job, plan, estimator, "test", 0.25 * seconds, _PIECE_PATHS // test_spp)
        total += _query_seconds(part) * test_count
    paths += test_count * test_spp
    return Forecast(
        seconds=total,
        start=start,
        query_seconds=each,
        paths=paths,
        paths_per_second=paths / max(start + total, 1e-9),
        paths_per_query=sum(p.stored for p in train) / traced,
        missed=sum(p.missed for p in train) / traced,
        bytes=(count + test_count) * row_bytes(plan.effects.on("opacity")),
        relative_error=error.value,
        relative_error_se=error.error,
        pilot_seconds=time.perf_counter() - began,
    )


def announce(console: Console, paths: float, seconds: Callable[[], float], size: float) -> None:
    """State the expected time and size of a command, unless no machine needs a minute for it.

    Parameters
    ----------
    paths : that it traces
    seconds : measures its duration; called for many paths only
    size : bytes that it writes
    """
    if paths >= LONG_RUN:
        console.note(expectation(seconds(), size))


def announce_shards(
    console: Console, job: Job, plan: RunPlan, entries: Sequence[ShardEntry], size: float
) -> None:
    """:func:`announce` for rendering some of the job's shards."""
    share = planned_paths(job, entries) / max(planned_paths(job, job.shards), 1)

    def seconds() -> float:
        expected = forecast(job, plan, seconds=1.0)
        return expected.start + share * expected.seconds

    announce(console, 0 if plan.effects.closed_form else share * most_paths(job), seconds, size)


def _piece(job: Job, plan: RunPlan, estimator: Any, split: Split, number: int, count: int) -> _Piece:
    """About `count` queries of a split, estimated as in the run, from the pilot's random streams."""
    spp, target = split_spp(job.config, split), split_target(job.config, split)
    start = time.perf_counter()
    queries = pilot_queries(job, max(1, min(count, split_queries(job, split))), number)
    stream = Stream(job.config.seed, "pilot", number)
    sampled = time.perf_counter()
    found = estimate_shard(estimator, queries, spp, target, stream, plan.allocation)
    traced = time.perf_counter()
    _write(queries, found)
    beside = sampled - start + time.perf_counter() - traced
    took = max(traced - sampled, 1e-9)
    n = len(queries.sigma)
    stored = n * spp if found.spp is None else int(found.spp.sum())
    missed = 0 if found.target is None else found.target.missed
    return _Piece(n, max(found.paths, stored), stored, missed, took, beside, found.value_a, found.value_b)


def _query_seconds(pieces: list[_Piece]) -> float:
    """Seconds of a query. Tracing uses all processors, so one of them samples and writes at its expense."""
    cores = os.cpu_count() or 1
    tracing = statistics.median(p.seconds / p.queries for p in pieces)
    beside = statistics.median(p.beside / p.queries for p in pieces)
    return max(tracing + beside / cores, beside)


def _write(queries: Queries, found: Estimates) -> None:
    """Write a piece like a shard, and delete it."""
    arrays = vars(queries) | {name: getattr(found, name) for name in ("value_a", "value_b")}
    arrays["spp"] = np.ones(len(queries.sigma), np.float32)
    with tempfile.TemporaryDirectory(prefix="mbtf-forecast-") as folder:
        write_shard(Path(folder) / "piece.npz", arrays)


def _pilot(job: Job, plan: RunPlan, estimator: Any, split: Split, seconds: float, size: int) -> list[_Piece]:
    """Pieces of a split of about `size` queries each."""
    began = time.perf_counter()
    pieces: list[_Piece] = []
    while len(pieces) < _FEWEST or time.perf_counter() - began < seconds:
        # Piece 0 was the warm-up.
        pieces.append(_piece(job, plan, estimator, split, len(pieces) + 1, size))
    return pieces

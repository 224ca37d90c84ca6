"""Forecast of the time, disk space and noise of a data set, from a pilot on this machine."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.app.console import Console
from mbtf_core.data.schema import Queries, ShardEntry, Split
from mbtf_core.data.shard_files import row_bytes, write_shard
from mbtf_core.forecast import pilot_seconds
from mbtf_core.stats import pooled_error
from mbtf_core.units import clock, expectation, size_text
from mbtf_gen.job import Job, most_paths, planned_paths, split_queries, split_spp, split_target
from mbtf_gen.planning.adaptive import estimate_shard
from mbtf_gen.planning.pilot import pilot_queries
from mbtf_gen.planning.run_plan import RunPlan
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream, Target

# Paths of one piece of the pilot.
_PIECE_PATHS = 1 << 19
# Fewer paths take less than a minute at half a million paths per second.
LONG_RUN = 30_000_000


@dataclass(frozen=True)
class Forecast:
    """Prediction for a data set.

    Attributes
    ----------
    seconds, seconds_se : float
        Of sampling, tracing and writing all queries with compiled kernels, and the standard error.
    start : float
        Seconds of loading, compiling and the pilot's first piece.
    query_seconds : float
        Seconds per training query.
    paths : int
        Of all splits, including the queries' own pilots under a target error.
    paths_per_query : float
        Mean over the training split, without pilots.
    bytes : int
        Of all shards.
    relative_error, relative_error_se : float
        RMS noise of one training value relative to the mean value, as in a run's summary, and its standard
        error.
    """

    seconds: float
    seconds_se: float
    start: float
    query_seconds: float
    paths: int
    paths_per_query: float
    bytes: int
    relative_error: float
    relative_error_se: float

    def describe(self, target: Target | None = None) -> str:
        """One line, two under a target error."""
        total = self.start + self.seconds
        line = (
            f"forecast: {clock(total)} ± {clock(self.seconds_se)}, "
            f"{self.paths / max(total, 1e-9) / 1e6:.2f} M paths/s ({self.start:.0f} s of startup included), "
            f"{size_text(self.bytes)}, noise of one training value {self.relative_error:.0%} of the mean "
            "value"
        )
        if target is None:
            return line
        return (
            f"{line}\n  {self.paths_per_query:.0f} paths per training query for an error of "
            f"{target.error:.2%} of max(value, tile mean)"
        )


class _Pilot:
    """Pieces of one split, estimated as in the run, from the pilot's random streams."""

    def __init__(self, job: Job, plan: RunPlan, estimator: Any, split: Split) -> None:
        self._job, self._plan, self._estimator, self._split = job, plan, estimator, split
        self.found: list[Estimates] = []
        self.spp = split_spp(job.config, split)
        self.target = split_target(job.config, split)
        self.size = max(1, _PIECE_PATHS // (self.spp if self.target is None else self.target.max_spp))

    def piece(self, number: int) -> int:
        """Sample, trace, write like a shard, and delete some queries; returns their number."""
        count = min(self.size, split_queries(self._job, self._split))
        queries = pilot_queries(self._job, max(1, count), number)
        stream = Stream(self._job.config.seed, "pilot", number)
        allocation = self._plan.allocation
        found = estimate_shard(self._estimator, queries, self.spp, self.target, stream, allocation)
        _write(queries, found)
        self.found.append(found)
        return len(found.value_a)

    @property
    def queries(self) -> int:
        """Number of queries so far."""
        return sum(len(found.value_a) for found in self.found)

    @property
    def stored(self) -> int:
        """Paths of the stored values."""
        return sum(
            self.spp * len(found.value_a) if found.spp is None else int(found.spp.sum())
            for found in self.found
        )

    @property
    def paths(self) -> int:
        """All paths, those of the queries' own pilots included."""
        return max(sum(found.paths for found in self.found), self.stored)


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
    train = _Pilot(job, plan, estimator, "train")
    # Piece 0 compiles the kernels. Under a target error it traces fewer paths than the cap allows.
    first = train.piece(0)
    start = time.perf_counter() - began
    train.size = max(1, _PIECE_PATHS * first // max(train.paths, 1))
    train.found.clear()
    each = pilot_seconds(train.piece, seconds)
    count, test_count = split_queries(job, "train"), split_queries(job, "test")
    total = each.scaled(count)
    expected, variance = total.value, total.error**2
    if test_count:
        test = pilot_seconds(_Pilot(job, plan, estimator, "test").piece, 0.25 * seconds).scaled(test_count)
        expected, variance = expected + test.value, variance + test.error**2
    a, b = (
        np.concatenate([getattr(found, name) for found in train.found]) for name in ("value_a", "value_b")
    )
    mean = 0.5 * float(np.mean(a, dtype=np.float64) + np.mean(b, dtype=np.float64))
    error = pooled_error(a, b).scaled(1.0 / mean if mean > 0 else 0.0)
    return Forecast(
        seconds=expected,
        seconds_se=variance**0.5,
        start=start,
        query_seconds=each.value,
        paths=round(count * train.paths / train.queries) + test_count * split_spp(job.config, "test"),
        paths_per_query=train.stored / train.queries,
        bytes=(count + test_count) * row_bytes(plan.effects.on("opacity")),
        relative_error=error.value,
        relative_error_se=error.error,
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


def _write(queries: Queries, found: Estimates) -> None:
    """Write a piece like a shard, and delete it."""
    arrays = vars(queries) | {name: getattr(found, name) for name in ("value_a", "value_b")}
    arrays["spp"] = np.ones(len(queries.sigma), np.float32)
    with tempfile.TemporaryDirectory(prefix="mbtf-forecast-") as folder:
        write_shard(Path(folder) / "piece.npz", arrays)

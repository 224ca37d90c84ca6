"""What a run will take and give, from a pilot on this very machine, before it starts."""

from __future__ import annotations

import math
import os
import statistics
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.console import clock
from mbtf_core.shard_schema import ARRAYS, SPLITS, Split
from mbtf_core.stats import pooled_error
from mbtf_gen.dataset.shard_io import write_shard
from mbtf_gen.planning.adaptive import Target, estimate_shard
from mbtf_gen.planning.effects import EffectsPlan
from mbtf_gen.planning.pilot import pilot_queries
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.sampling.query_sampler import Queries

if TYPE_CHECKING:
    from mbtf_gen.generation import Job

# Paths of one piece of the pilot, and the fewest pieces that are timed.
_PIECE_PATHS = 1 << 19
_FEWEST = 3


@dataclass(frozen=True)
class Forecast:
    """What is expected of a run.

    Attributes
    ----------
    seconds : of tracing, once kernels are compiled, and what drawing queries and writing take beside it
    start : of loading, compiling and the pilot's first piece
    query_seconds : of a training query, all told
    paths : of all splits, under a target error with those of the queries' own pilots
    paths_per_second : of the training split, in the pilot
    paths_per_query : mean over the training split, pilots not counted
    missed : share of training queries that the cap on paths keeps from the target error; 0 without one
    bytes : of all shards
    relative_error : RMS noise of one training value relative to the mean value, as a run's summary has it
    relative_error_se : its standard error
    pilot_seconds : what the forecast took
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
            f"forecast: {clock(self.seconds)} of tracing and writing ({self.paths_per_second / 1e6:.2f} M "
            f"paths/s traced, after {self.start:.0f} s of starting), {size_text(self.bytes)}, noise of "
            f"one training value {self.relative_error:.0%} of the mean value"
        )
        if target is None:
            return line
        missed = f"; {self.missed:.1%} of the queries stop at the cap of {target.cap}" if self.missed else ""
        need = f"{self.paths_per_query:.0f} paths per training query for an error of {target.error:.2%}"
        return f"{line}\n  {need} of max(value, tile mean){missed}"

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON; numbers that are not finite become None."""
        return {
            k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in asdict(self).items()
        }


def size_text(size: float) -> str:
    """``812 kB``, ``64 MB``, ``1.7 GB``."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6)):
        if size >= factor:
            return f"{size / factor:.{1 if size < 10 * factor else 0}f} {unit}"
    return f"{size / 1e3:.0f} kB"


def row_bytes(holes: bool) -> int:
    """Bytes of one query in a shard."""
    wanted = [a for a in ARRAYS if holes or not a.optional]
    return sum(4 * max(1, math.prod(a.trailing)) for a in wanted)


@dataclass(frozen=True)
class _Piece:
    """What one piece of a pilot took and gave: queries, paths in all and those that would be stored, queries
    that missed a target, seconds of tracing, of drawing queries and writing, both halves."""

    queries: int
    paths: int
    stored: int
    missed: int
    seconds: float
    beside: float
    value_a: NDArray[np.float32]
    value_b: NDArray[np.float32]


def forecast(job: Job, plan: EffectsPlan, seconds: float = 2.0) -> Forecast:
    """Trace a little of each split and say what all of it will take.

    Parameters
    ----------
    plan : effects of the run, with its allocation where the run has a target error
    seconds : spent on the training split at most, beyond the first pieces
    """
    began = time.perf_counter()
    estimator = job.estimator(plan)
    target = job.target("train")
    first = _piece(
        job, plan, estimator, "train", 0, _PIECE_PATHS // (job.spp("train") if target is None else target.cap)
    )
    start = time.perf_counter() - began
    # A target error takes other numbers of paths.
    size = max(1, _PIECE_PATHS * first.queries // max(first.paths, 1))
    train = _pilot(job, plan, estimator, "train", seconds, size)
    a, b = (np.concatenate([getattr(p, name) for p in train]) for name in ("value_a", "value_b"))
    mean = 0.5 * float(np.mean(a, dtype=np.float64) + np.mean(b, dtype=np.float64))
    error = pooled_error(a, b).scaled(1.0 / mean if mean > 0 else 0.0)
    tried = sum(p.queries for p in train)
    paths = round(job.queries("train") * sum(p.paths for p in train) / tried)
    rate = statistics.median(p.paths / p.seconds for p in train)
    each = _query_seconds(train)
    took = each * job.queries("train")
    if test := job.queries("test") * job.spp("test"):
        part = _pilot(job, plan, estimator, "test", 0.25 * seconds, _PIECE_PATHS // job.spp("test"))
        took += _query_seconds(part) * job.queries("test")
    queries = sum(job.queries(split) for split in SPLITS)
    return Forecast(
        seconds=took,
        start=start,
        query_seconds=each,
        paths=paths + test,
        paths_per_second=rate,
        paths_per_query=sum(p.stored for p in train) / tried,
        missed=sum(p.missed for p in train) / tried,
        bytes=queries * row_bytes(plan.on("opacity")),
        relative_error=error.value,
        relative_error_se=error.error,
        pilot_seconds=time.perf_counter() - began,
    )


def _piece(job: Job, plan: EffectsPlan, estimator: Any, split: Split, number: int, count: int) -> _Piece:
    """About `count` queries of a split, estimated as the run does, from streams of the pilot's own."""
    spp, target = job.spp(split), job.target(split)
    start = time.perf_counter()
    queries = pilot_queries(job, max(1, min(count, job.queries(split))), number)
    stream = Stream(job.config.seed, "pilot", number)
    drawn = time.perf_counter()
    found = estimate_shard(estimator, queries, spp, target, stream, plan)
    traced = time.perf_counter()
    _write(queries, found)
    beside = drawn - start + time.perf_counter() - traced
    took = max(traced - drawn, 1e-9)
    n = len(queries.sigma)
    stored = n * spp if found.spp is None else int(found.spp.sum())
    missed = 0 if found.target is None else found.target.missed
    return _Piece(n, max(found.paths, stored), stored, missed, took, beside, found.value_a, found.value_b)


def _query_seconds(pieces: list[_Piece]) -> float:
    """Seconds of a query: tracing keeps all processors busy, so what is drawn and written beside it takes its
    time from them, shared among them."""
    cores = os.cpu_count() or 1
    tracing = statistics.median(p.seconds / p.queries for p in pieces)
    beside = statistics.median(p.beside / p.queries for p in pieces)
    return max(tracing + beside / cores, beside)


def _write(queries: Queries, found: Estimates) -> None:
    """Write a piece as a shard is written, and forget it."""
    arrays = {
        "u": queries.u,
        "sigma": queries.sigma,
        "omega_i": queries.omega_i,
        "omega_o": queries.omega_o,
        "value_a": found.value_a,
        "value_b": found.value_b,
        "spp": np.ones(len(queries.sigma), np.float32),
    }
    with tempfile.TemporaryDirectory(prefix="mbtf-forecast-") as folder:
        write_shard(Path(folder) / "piece.npz", arrays)


def _pilot(
    job: Job, plan: EffectsPlan, estimator: Any, split: Split, seconds: float, size: int
) -> list[_Piece]:
    """Pieces of a split of about `size` queries each."""
    began = time.perf_counter()
    pieces: list[_Piece] = []
    while len(pieces) < _FEWEST or time.perf_counter() - began < seconds:
        # Piece 0 has warmed up.
        pieces.append(_piece(job, plan, estimator, split, len(pieces) + 1, size))
    return pieces

"""What a run will take and give, from a pilot on this very machine, before it starts."""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .adaptive import Target, estimate_shard
from .console import clock
from .effects import EffectsPlan
from .estimates import Stream
from .pilot import pilot_queries
from .schema import ARRAYS, SPLITS, Split
from .stats import pooled_error

if TYPE_CHECKING:
    from .generation import Job

# Paths of one piece of the pilot, and the fewest pieces that are timed.
_PIECE_PATHS = 1 << 19
_FEWEST = 3


@dataclass(frozen=True)
class Forecast:
    """What is expected of a run.

    Attributes
    ----------
    seconds : of tracing, once kernels are compiled; start : of loading, compiling and the pilot's first piece
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
            f"forecast: {clock(self.seconds)} of tracing ({self.paths_per_second / 1e6:.2f} M paths/s, after "
            f"{self.start:.0f} s of starting), {size_text(self.bytes)}, noise of one training value "
            f"{self.relative_error:.0%} of the mean value"
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
    that missed a target, seconds, both halves."""

    queries: int
    paths: int
    stored: int
    missed: int
    seconds: float
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
    took = paths / rate
    if test := job.queries("test") * job.spp("test"):
        part = _pilot(job, plan, estimator, "test", 0.25 * seconds, _PIECE_PATHS // job.spp("test"))
        took += test / statistics.median(p.paths / p.seconds for p in part)
    queries = sum(job.queries(split) for split in SPLITS)
    return Forecast(
        seconds=took,
        start=start,
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
    queries = pilot_queries(job, max(1, min(count, job.queries(split))), number)
    stream = Stream(job.config.seed, "pilot", number)
    start = time.perf_counter()
    found = estimate_shard(estimator, queries, spp, target, stream, plan)
    took = max(time.perf_counter() - start, 1e-9)
    n = len(queries.sigma)
    stored = n * spp if found.spp is None else int(found.spp.sum())
    missed = 0 if found.target is None else found.target.missed
    return _Piece(n, max(found.paths, stored), stored, missed, took, found.value_a, found.value_b)


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

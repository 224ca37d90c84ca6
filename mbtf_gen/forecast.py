"""What a run will take and give, from a pilot on this very machine, before it starts."""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

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
    paths : of all splits; paths_per_second : of the training split, in the pilot
    bytes : of all shards
    relative_error : RMS noise of one training value relative to the mean value, as a run's summary has it
    relative_error_se : its standard error
    pilot_seconds : what the forecast took
    """

    seconds: float
    start: float
    paths: int
    paths_per_second: float
    bytes: int
    relative_error: float
    relative_error_se: float
    pilot_seconds: float

    def describe(self) -> str:
        """One line."""
        return (
            f"forecast: {clock(self.seconds)} of tracing ({self.paths_per_second / 1e6:.2f} M paths/s, after "
            f"{self.start:.0f} s of starting), {size_text(self.bytes)}, noise of one training value "
            f"{self.relative_error:.0%} of the mean value"
        )

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


def forecast(job: Job, plan: EffectsPlan, seconds: float = 2.0) -> Forecast:
    """Trace a little of each split and say what all of it will take.

    Parameters
    ----------
    plan : effects of the run
    seconds : spent on the training split at most, beyond the first pieces
    """
    began = time.perf_counter()
    estimator = job.estimator(plan)
    _piece(job, estimator, "train", 0)
    start = time.perf_counter() - began
    rate, a, b = _pilot(job, estimator, "train", seconds)
    mean = 0.5 * float(np.mean(a, dtype=np.float64) + np.mean(b, dtype=np.float64))
    error = pooled_error(a, b).scaled(1.0 / mean if mean > 0 else 0.0)
    paths = {split: job.queries(split) * job.spp(split) for split in SPLITS}
    took = paths["train"] / rate
    if paths["test"]:
        took += paths["test"] / _pilot(job, estimator, "test", 0.25 * seconds)[0]
    queries = sum(job.queries(split) for split in SPLITS)
    return Forecast(
        seconds=took,
        start=start,
        paths=sum(paths.values()),
        paths_per_second=rate,
        bytes=queries * row_bytes(plan.on("opacity")),
        relative_error=error.value,
        relative_error_se=error.error,
        pilot_seconds=time.perf_counter() - began,
    )


def _piece(job: Job, estimator: Any, split: Split, number: int) -> tuple[float, NDArray[Any], NDArray[Any]]:
    """(paths per second, both halves) of one piece of a split's queries, from streams of the pilot's own."""
    spp = job.spp(split)
    count = max(1, min(_PIECE_PATHS // spp, max(1, job.queries(split))))
    queries = pilot_queries(job, count, number)
    start = time.perf_counter()
    found = estimator.estimate(queries, spp, Stream(job.config.seed, "pilot", number))
    took = max(time.perf_counter() - start, 1e-9)
    return len(queries.sigma) * spp / took, found.value_a, found.value_b


def _pilot(
    job: Job, estimator: Any, split: Split, seconds: float
) -> tuple[float, NDArray[np.float32], NDArray[np.float32]]:
    """(median paths per second, both halves of all pieces)."""
    began = time.perf_counter()
    pieces: list[tuple[float, NDArray[np.float32], NDArray[np.float32]]] = []
    while len(pieces) < _FEWEST or time.perf_counter() - began < seconds:
        # Piece 0 has warmed up.
        pieces.append(_piece(job, estimator, split, len(pieces) + 1))
    rates, first, second = zip(*pieces, strict=True)
    return statistics.median(rates), np.concatenate(first), np.concatenate(second)

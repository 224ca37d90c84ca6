"""Estimates of M at queries, and the streams of random numbers that they use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.documents import BadSample, TargetReached

# Non-finite samples whose location is kept.
MOST_LOCATED = 8
# Paths of each query's own pilot under a target error.
TARGET_PILOT_SPP = 16


@dataclass(frozen=True)
class Target:
    """Standard error that every value is to reach.

    Attributes
    ----------
    error : relative to max(value, tile mean)
    max_spp : paths that a query gets at most, without its pilot
    """

    error: float
    max_spp: int


@dataclass(frozen=True)
class Estimates:
    """Estimates of a batch of queries.

    Attributes
    ----------
    value_a, value_b : (n, 3), independent halves of spp/2 paths each, in 1/sr
    transmittance : (n,), fraction of the view rays that the opacity mask transmits; None without a mask
    paths, lost, capped : paths traced, rays that passed through the surface without a hit, and rays that
        reached the cap on crossings
    nonfinite, bad_samples : int, tuple of BadSample; number of non-finite samples, which were drawn again,
        and the first ``MOST_LOCATED`` of them
    spp : (n,), paths of each query, both halves together; None where all have the same number
    path_variance : (n,), sample variance of each query's single paths, mean over channels, if requested
    target : error reached under a target error
    """

    value_a: NDArray[np.float32]
    value_b: NDArray[np.float32]
    transmittance: NDArray[np.float32] | None
    paths: int
    lost: int
    capped: int
    nonfinite: int
    bad_samples: tuple[BadSample, ...] = ()
    spp: NDArray[np.int64] | None = None
    path_variance: NDArray[np.float32] | None = None
    target: TargetReached | None = None


@dataclass(frozen=True)
class Stream:
    """Random numbers to use: those of a shard under a root seed.

    Attributes
    ----------
    root, split, shard : root seed; split of the shard; number of the shard in the split
    first_pass : number of the first pass. Every pass draws all paths anew; later passes replace non-finite
        samples
    """

    root: int
    split: str
    shard: int
    first_pass: int = 0

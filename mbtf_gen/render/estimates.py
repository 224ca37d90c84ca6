"""What an estimator returns, and which random numbers it uses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
class BadSample:
    """Where a sample came out non-finite.

    Attributes
    ----------
    query : its number in the batch, or in the shard
    effect : what brought it there: ``direct light``, or ``interreflection``
    """

    query: int
    effect: str


@dataclass(frozen=True)
class TargetReached:
    """How close a batch of queries came to a target error, relative to max(value, tile mean).

    Attributes
    ----------
    queries : in all; missed : those that would have needed more paths than the cap
    worst : largest error that the pilot expects of one of those that missed; 0 where none did
    square : mean square of the relative error reached, from the stored halves
    """

    queries: int
    missed: int
    worst: float
    square: float


@dataclass(frozen=True)
class Estimates:
    """Estimates of a batch of queries.

    Attributes
    ----------
    value_a, value_b : (n, 3) float32, independent halves of spp/2 paths each
    transmittance : (n,) float32, share of the view rays that went through holes; None where there are none
    paths : paths traced; lost : rays that slipped through the surface; capped : rays cut at the cap on
        crossings
    nonfinite : samples that came out non-finite and were drawn again
    bad_samples : the first of them, at most ``MOST_LOCATED``
    spp : (n,) int64, paths of each query, both halves together; None where they are all the same
    path_variance : (n,) float32, sample variance of the query's single paths, mean over channels; None where
        it was not asked for
    target : what a run to a target error reached
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
    """Which random numbers to use: split and number of the shard under a root seed, and the first pass.

    A pass draws all paths anew; those after the first are for paths that came out non-finite.
    """

    root: int
    split: str
    shard: int
    first_pass: int = 0

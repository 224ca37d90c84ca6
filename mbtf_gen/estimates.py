"""What an estimator returns, and which random numbers it uses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Non-finite samples whose place is kept.
MOST_LOCATED = 8


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


@dataclass(frozen=True)
class Stream:
    """Which random numbers to use: split and number of the shard under a root seed."""

    root: int
    split: str
    shard: int

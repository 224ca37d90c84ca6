r"""Low-discrepancy points inside kernels: Owen-scrambled Sobol' points, padded pair by pair.

The paths of one half of a query are the points 0, 1, 2, … of one randomized sequence; half, query, shard and
root seed select the randomization, so halves are independent and values do not depend on how paths are
grouped into launches. Every sample of a path is one *dimension* of the sequence, of one or two coordinates:

- the coordinates are the first one or two of Sobol' (1967), for two a (0, m, 2)-net: any 2^m consecutive
  points that begin at a multiple of 2^m put exactly one point into each of the 2^m boxes of every shape
  2^-j × 2^-(m-j);
- each coordinate is scrambled after Owen (1995), which preserves the net and makes every point uniform, so
  that estimates are unbiased for any number of points;
- the order of the points is scrambled separately for each dimension, so that dimensions are independent
  (Burley 2020, "Practical Hash-based Owen Scrambling").

Scrambling by hashing follows Laine and Karras (2011) with the constants of Vegdahl (2021). All of it is
32-bit integer arithmetic, and a path's state is four numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

# The lower half of the counter counts dimensions, the upper half plain random numbers.
_CHANCE_STEP = 1 << 16
_DIMENSIONS = _CHANCE_STEP - 1


def mix(x: Any) -> Any:
    """Hash of ``mi.UInt32``, a bijection: ``lowbias32`` (Wellons 2018)."""
    x = (x ^ (x >> 16)) * mi.UInt32(0x7FEB352D)
    x = (x ^ (x >> 15)) * mi.UInt32(0x846CA68B)
    return x ^ (x >> 16)


def _scramble(x: Any, seed: Any) -> Any:
    """Owen scrambling of a bit-reversed number: each bit's flip depends on the lower bits alone."""
    x = x ^ (x * mi.UInt32(0x3D20ADEA))
    x = (x + seed) * ((seed >> 16) | 1)
    x = x ^ (x * mi.UInt32(0x05526C56))
    return x ^ (x * mi.UInt32(0x53A22864))


def _second_coordinate(i: Any) -> Any:
    """Sobol's second coordinate of point i, bit-reversed: i times Pascal's triangle modulo 2."""
    i = i ^ (i >> 16)
    i = i ^ ((i & 0xFF00FF00) >> 8)
    i = i ^ ((i & 0xF0F0F0F0) >> 4)
    i = i ^ ((i & 0xCCCCCCCC) >> 2)
    return i ^ ((i & 0xAAAAAAAA) >> 1)


def _unit(x: Any) -> Any:
    """Number in [0, 1) from the upper 24 bits."""
    return mi.Float(x >> 8) * (1.0 / (1 << 24))


@dataclass
class SobolSampler:
    """State of the sequences of all lanes.

    Attributes
    ----------
    key, salt : mi.UInt32
        Randomization of 64 bits, from :func:`sequence`.
    index : mi.UInt32
        Number of the point.
    counter : mi.UInt32
        Dimensions sampled so far (lower half) and plain random numbers (upper half).
    """

    key: Any
    salt: Any
    index: Any
    counter: Any

    def _seed(self, dimension: Any) -> Any:
        return mix(mix(self.key + dimension * mi.UInt32(0x9E3779B9)) ^ self.salt)

    def _next(self) -> tuple[Any, Any]:
        """(the next dimension's seed, its scrambled number of the point)."""
        seed = self._seed(self.counter & _DIMENSIONS)
        self.counter = self.counter + 1
        return seed, dr.brev(_scramble(dr.brev(self.index), mix(seed + 1)))

    def next_1d(self) -> Any:
        """The next dimension, of one coordinate in [0, 1)."""
        seed, index = self._next()
        return _unit(dr.brev(_scramble(index, mix(seed + 2))))

    def next_2d(self) -> Any:
        """The next dimension, of two coordinates in [0, 1)."""
        seed, index = self._next()
        x = dr.brev(_scramble(index, mix(seed + 2)))
        y = dr.brev(_scramble(_second_coordinate(index), mix(seed + 3)))
        return mi.Point2f(_unit(x), _unit(y))

    def chance(self) -> Any:
        """A pseudo-random number in [0, 1) outside the sequence, for decisions that not all paths make."""
        number = self.counter >> 16
        self.counter = self.counter + _CHANCE_STEP
        return _unit(mix(self._seed(~number) ^ mix(self.index + 0x68E31DA4)))


def sequence(key: Any, salt: Any, query: Any, index: Any) -> SobolSampler:
    """The sequences of the queries of a stream.

    Parameters
    ----------
    key, salt : UInt32
        Lower and upper half of :func:`~mbtf_gen.sampling.rng.stream_key`, one or one per lane.
    query, index : UInt32
        Number of the query in its shard, and of the path within its half of the query.
    """
    # Two independent bijections of the query's number.
    return SobolSampler(
        mix(query ^ key), mix(query * mi.UInt32(0x2C1B3C6D) + salt), mi.UInt32(index), mi.UInt32(query) * 0
    )

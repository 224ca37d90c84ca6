"""Random streams, an injective function of (root seed, split, shard, purpose, pass, half).

Queries are drawn with NumPy's Philox, a counter-based generator whose key holds all of these numbers
unhashed. Paths are drawn inside kernels with PCG32 (O'Neill 2014), one generator per path: its sequence
number holds the fields other than the root seed, its start all of them and the path's number, hashed, so that
no value depends on how paths are grouped into launches.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np

MAX_SHARDS = 1 << 28
# Data splits, reference pictures and pilots draw from streams of their own.
_SPLIT_NUMBER: dict[str, int] = {"train": 0, "test": 1, "reference": 2, "pilot": 3}


class Purpose(IntEnum):
    """What a stream is for."""

    TEXEL_ORDER = 0
    QUERIES = 1
    FOOTPRINT = 2
    PATH = 3


def stream_number(split: str, shard: int, purpose: Purpose, pass_index: int = 0, half: int = 0) -> int:
    """Pack the fields into 47 bits: split (2), half (1), purpose (4), pass (12), shard (28)."""
    if not 0 <= shard < MAX_SHARDS:
        raise ValueError(f"shard number must lie in 0..{MAX_SHARDS - 1}, not {shard}")
    if not 0 <= pass_index < 1 << 12 or half not in (0, 1):
        raise ValueError(f"pass {pass_index}, half {half} out of range")
    number = _SPLIT_NUMBER[split]
    for value, bits in ((half, 1), (int(purpose), 4), (pass_index, 12), (shard, 28)):
        number = (number << bits) | value
    return number


def numpy_generator(
    root: int, split: str, shard: int, purpose: Purpose, pass_index: int = 0
) -> np.random.Generator:
    """NumPy generator of a stream; its bits are the same on every machine."""
    key = np.array([root, stream_number(split, shard, purpose, pass_index)], np.uint64)
    return np.random.Generator(np.random.Philox(key=key))


def _mix(x: Any) -> Any:
    """The finaliser of MurmurHash3 (Appleby), a bijection of ``mi.UInt64``."""
    import mitsuba as mi

    x = (x ^ (x >> 33)) * mi.UInt64(0xFF51AFD7ED558CCD)
    x = (x ^ (x >> 33)) * mi.UInt64(0xC4CEB9FE1A85EC53)
    return x ^ (x >> 33)


def path_generator(root: int, stream: Any, lane: Any) -> Any:
    """PCG32 inside a kernel, one per lane.

    Parameters
    ----------
    root : root seed; stream : ``mi.UInt64``, numbers from :func:`stream_number`, one or one per lane
    lane : ``mi.UInt64``, number of the path within its stream
    """
    import drjit as dr
    import mitsuba as mi

    # PCG32 sequences of different numbers that start from one state stay a constant apart, the same for every
    # start, and are anything but independent. So every field goes into the start, each hashed before the next
    # is added: neighbouring root seeds then share nothing either.
    key = _mix(_mix(stream + mi.UInt64(1)) + dr.opaque(mi.UInt64, root))
    return mi.PCG32(initstate=_mix(key + lane * mi.UInt64(0x9E3779B97F4A7C15)), initseq=stream)

"""Random streams, an injective function of (root seed, split, shard, purpose, pass, half).

Queries are sampled with NumPy's Philox, a counter-based generator whose key contains all of these numbers
unhashed. Paths use low-discrepancy sequences inside kernels (:mod:`mbtf_gen.sampling.sobol`), one for each
half of each query. The fields are hashed into a 64-bit key, from which the queries of one stream derive
distinct keys, so that values do not depend on how paths are grouped into launches.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

MAX_SHARDS = 1 << 28
# Data splits, reference pictures and pilots have separate streams.
_SPLIT_NUMBER: dict[str, int] = {"train": 0, "test": 1, "reference": 2, "pilot": 3}


class Purpose(IntEnum):
    """Purpose of a stream."""

    TEXEL_ORDER = 0
    QUERIES = 1
    FOOTPRINT = 2
    PATH = 3
    CHOICE = 4
    LIGHTS = 5


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
    """NumPy generator of a stream; its bits are the same on every machine (see :func:`stream_number`)."""
    key = np.array([root, stream_number(split, shard, purpose, pass_index)], np.uint64)
    return np.random.Generator(np.random.Philox(key=key))


_WORD = (1 << 64) - 1


def _mix(x: int) -> int:
    """The finaliser of MurmurHash3 (Appleby), a bijection of 64-bit numbers."""
    x = (x ^ (x >> 33)) * 0xFF51AFD7ED558CCD & _WORD
    x = (x ^ (x >> 33)) * 0xC4CEB9FE1A85EC53 & _WORD
    return x ^ (x >> 33)


def stream_key(root: int, number: int) -> int:
    """64-bit key of the paths of a stream; `number` from :func:`stream_number`."""
    # Each is hashed before the next is added, so that neighboring root seeds are independent.
    return _mix(_mix(number + 1) + root & _WORD)

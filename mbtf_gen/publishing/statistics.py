"""The numbers of a card: mean and noise of each split, with standard errors.

They are those of evenly spaced rows of all shards, about a million queries at most. Independent units are
queries of the shuffled layout, images of the image layout, positions of the slices layout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mbtf_core.data.dataset import Shard
from mbtf_core.data.shard_files import Arrays
from mbtf_core.stats.estimate import Estimate, mean_estimate
from mbtf_core.stats.paired import pooled_relative_error
from mbtf_gen.measured.exported import mean_of

# Queries that are averaged at most.
_QUERIES = 1 << 20


@dataclass(frozen=True)
class SplitStatistics:
    """Statistics of a split.

    Attributes
    ----------
    queries : int
        Number of queries of the whole split.
    mean : tuple of Estimate
        Mean value of each color channel, in 1/sr.
    noise : Estimate or None
        RMS noise of the value of one query over the RMS value; None of measured data, whose noise is unknown.
    """

    queries: int
    mean: tuple[Estimate, ...]
    noise: Estimate | None


def sample(shards: Sequence[Shard]) -> Arrays:
    """Evenly spaced rows of shards, about a million queries at most.

    Parameters
    ----------
    shards : sequence of Shard
        At least one.

    Returns
    -------
    dict of str to float32 array

    Raises
    ------
    InputError
        A shard cannot be read.
    """
    queries = sum(shard.rows for shard in shards) * int(np.prod(shards[0].image, dtype=int))
    step = -(-queries // _QUERIES)
    parts = [{name: np.array(a[::step]) for name, a in shard.read().items()} for shard in shards]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def split_statistics(shards: Sequence[Shard]) -> SplitStatistics:
    """Statistics of the shards of a split.

    Parameters
    ----------
    shards : sequence of Shard
        At least one.

    Returns
    -------
    SplitStatistics

    Raises
    ------
    InputError
        A shard cannot be read.
    """
    arrays = sample(shards)
    value = mean_of(arrays)
    noise = pooled_relative_error(arrays["value_a"], arrays["value_b"]) if "value_b" in arrays else None
    queries = sum(shard.rows for shard in shards) * int(np.prod(shards[0].image, dtype=int))
    return SplitStatistics(queries, tuple(mean_estimate(value[..., c]) for c in range(3)), noise)

"""Batches of a data set for training code of your own, as PyTorch's loaders take them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import Tensor, from_numpy, int64, zeros
from torch.utils.data import IterableDataset, get_worker_info

from mbtf_core.data.dataset import Dataset, Shard
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.shard_files import check_values
from mbtf_core.errors import InputError, check_type
from mbtf_fit.data.layouts import philox
from mbtf_fit.data.queries import ShardQueries, needed

# Queries that are read at once from one shard, and how many such blocks are shuffled together.
_BLOCK, _MIXED = 4096, 32


class QueryBatch(NamedTuple):
    """Queries with both estimates of their value, float32 tensors.

    Attributes
    ----------
    u : Tensor
        (n, 2) positions, uv.
    sigma : Tensor
        (n,) footprints in tile widths.
    omega_i, omega_o : Tensor
        (n, 3) unit vectors towards light and viewer.
    value_a, value_b : Tensor
        (n, 3) independent estimates of M in 1/sr; of measured data, which have one, the same numbers.
    weight : Tensor
        (n,) weights in means over queries; 1 where the data have none.
    """

    u: Tensor
    sigma: Tensor
    omega_i: Tensor
    omega_o: Tensor
    value_a: Tensor
    value_b: Tensor
    weight: Tensor


class QueryDataset(IterableDataset[QueryBatch]):
    """All queries of a split once per epoch, in batches, in all layouts: training queries in random order.

    An epoch visits blocks of about 4096 queries of all shards in random order, and shuffles 32 of them at a
    time: memory does not grow with the data set. The order depends on seed, epoch and number of workers
    alone. A loader takes batches as they are: ``DataLoader(queries, batch_size=None, num_workers=2)``; each
    worker makes batches of its own. ``len()`` is the number of batches of an epoch, of one worker or many.

    Parameters
    ----------
    folder : str, Path or DataFolder
        The data set.
    split : str
        ``train`` or ``test``.
    batch_size : int
        Queries per batch; one batch may have fewer.
    seed : int
        Of the order.
    shuffle : bool, optional
        Whether batches have random order; by default those of the train split alone. Otherwise, without
        workers of a loader, queries have the order of the shards.

    Attributes
    ----------
    data : Dataset
        The opened data set.
    count : int
        Number of queries.

    Raises
    ------
    InputError
        There is no complete data set, or, while it is read, a shard is missing or corrupt.
    """

    def __init__(
        self,
        folder: str | Path | DataFolder,
        split: str = "train",
        batch_size: int = 4096,
        seed: int = 0,
        shuffle: bool | None = None,
    ) -> None:
        super().__init__()
        check_type(batch_size, int, "batch_size", "give a whole number")
        if batch_size < 1:
            raise InputError(f"is {batch_size}, but must be at least 1", where="batch_size")
        self.shuffle = split == "train" if shuffle is None else shuffle
        self.data, self.batch_size, self.seed = Dataset.open(folder), batch_size, seed
        # Shared with workers, also with those that live for several epochs.
        self._epoch = zeros((), dtype=int64).share_memory_()
        self._blocks: list[tuple[Shard, int, int]] = []
        self._sizes: list[int] = []
        for shard in self.data.shards(split):
            each = int(np.prod(shard.image, dtype=int))
            step = max(1, _BLOCK // each)
            blocks = [(shard, at, min(at + step, shard.rows)) for at in range(0, shard.rows, step)]
            self._blocks += blocks
            self._sizes += [each * (stop - start) for _, start, stop in blocks]
        self.count = sum(self._sizes)

    def __len__(self) -> int:
        return -(-self.count // self.batch_size)

    def set_epoch(self, epoch: int) -> None:
        """Select the order of an epoch; call it before each. Epochs of one number have one order."""
        self._epoch.fill_(epoch)

    def __iter__(self) -> Iterator[QueryBatch]:
        worker = get_worker_info()
        number, workers = (0, 1) if worker is None else (worker.id, worker.num_workers)
        epoch = int(self._epoch)
        order = np.arange(len(self._blocks))
        if self.shuffle:
            order = philox(self.seed, 2 * epoch).permutation(order)
        # The worker's share of the queries in this order: whole batches, but for the last one of all.
        first, last = (k * len(self) // workers * self.batch_size for k in (number, number + 1))
        sizes = np.asarray(self._sizes, np.int64)[order]
        ends = np.cumsum(sizes)
        parts = [
            (int(block), slice(max(0, first - start), last - start))
            for block, start, end in zip(order, ends - sizes, ends, strict=True)
            if start < last and first < end
        ]
        # As in the loader's batches, even streams order an epoch, odd ones what is below.
        random = np.random.Generator(np.random.Philox(key=[self.seed, 2 * epoch + 1], counter=number))
        left: list[ShardQueries] = []
        for start in range(0, len(parts), _MIXED):
            found = (self._read(block).take(part) for block, part in parts[start : start + _MIXED])
            mixed = ShardQueries.join([*left, *found])
            if self.shuffle:
                mixed = mixed.take(random.permutation(len(mixed)))
            whole = len(mixed) // self.batch_size * self.batch_size
            for at in range(0, whole, self.batch_size):
                yield _batch(mixed.take(slice(at, at + self.batch_size)))
            left = [mixed.take(slice(whole, None))] if whole < len(mixed) else []
        for rest in left:
            yield _batch(rest)

    def _read(self, block: int) -> ShardQueries:
        shard, start, stop = self._blocks[block]
        mapped = shard.map(needed(shard.estimates, shard.weighted))
        arrays = {name: np.array(array[start:stop]) for name, array in mapped.items()}
        check_values(arrays, shard.where)
        return ShardQueries.of(arrays).flat()


def _batch(queries: ShardQueries) -> QueryBatch:
    weight = np.ones_like(queries.sigma) if queries.weight is None else queries.weight
    arrays = vars(queries) | {"weight": weight}
    return QueryBatch(*(from_numpy(np.array(arrays[name])) for name in QueryBatch._fields))

"""Rows of the shards that are trained on, and batches of them read from memory-mapped shards.

Data that exceed the memory limit stay on disk. A batch has the same rows in the same order as in memory, so
that the fit does not depend on where the data lie.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from mbtf_core.data.dataset import Shard
from mbtf_core.data.shard_files import Arrays
from mbtf_fit.data.queries import TrainingQueries, batch_starts, mean_value, needed

# Rows of a shard between two cumulative counts of selected rows.
_BLOCK = 4096


class Selection:
    """Selected rows of shards, numbered consecutively; one bit per row.

    Attributes
    ----------
    shards : in the order in which they were added
    starts : index of the first selected row of each shard, and the number of all selected rows
    """

    def __init__(self) -> None:
        self.shards: list[Shard] = []
        self.starts: list[int] = [0]
        self._bits: list[NDArray[np.uint8]] = []
        self._counts: list[NDArray[np.int64]] = []
        self._sizes: list[int] = []

    def __len__(self) -> int:
        return self.starts[-1]

    def add(self, shard: Shard, chosen: NDArray[np.bool_]) -> None:
        """Append a shard with a mask of its selected rows."""
        blocks = np.add.reduceat(chosen, np.arange(0, len(chosen), _BLOCK), dtype=np.int64)
        self.shards.append(shard)
        self._sizes.append(len(chosen))
        self._bits.append(np.packbits(chosen))
        self._counts.append(np.concatenate([[0], np.cumsum(blocks)]))
        self.starts.append(self.starts[-1] + int(self._counts[-1][-1]))

    def masks(self) -> Iterator[tuple[Shard, NDArray[np.bool_]]]:
        """(shard, mask of its selected rows)."""
        for shard, bits, size in zip(self.shards, self._bits, self._sizes, strict=True):
            yield shard, np.unpackbits(bits, count=size).astype(bool)

    def _rows(self, shard: int, start: int, stop: int) -> NDArray[np.int64]:
        counts = self._counts[shard]
        first = int(np.searchsorted(counts, start, "right")) - 1
        last = int(np.searchsorted(counts, stop, "left"))
        bits = self._bits[shard][first * _BLOCK // 8 : last * _BLOCK // 8]
        rows = np.flatnonzero(np.unpackbits(bits)) + first * _BLOCK
        return rows[start - counts[first] : stop - counts[first]]

    def pieces(self, start: int, stop: int) -> Iterator[tuple[Shard, NDArray[np.int64]]]:
        """(shard, rows) of the selected rows with indices in [start, stop)."""
        for shard, (begin, end) in enumerate(pairwise(self.starts)):
            low, high = max(start, begin), min(stop, end)
            if low < high:
                yield self.shards[shard], self._rows(shard, low - begin, high - begin)


class StreamedQueries:
    """Training queries on disk: rows of npz shards with so many estimates of every value, and the device of
    the batches. Each batch maps the shards that it reads, and then releases them."""

    def __init__(
        self, selection: Selection, device: torch.device | None = None, *, estimates: int = 2
    ) -> None:
        self.selection = selection
        self.estimates = estimates
        self.device = device or torch.device("cpu")

    def __len__(self) -> int:
        return len(self.selection)

    def to(self, device: torch.device) -> StreamedQueries:
        """The same queries with batches on another device."""
        return StreamedQueries(self.selection, device, estimates=self.estimates)

    def slice(self, start: int, stop: int) -> TrainingQueries:
        """Consecutive queries, read from disk."""
        parts: list[Arrays] = []
        for shard, rows in self.selection.pieces(start, stop):
            mapped = shard.map(needed(self.estimates))
            span, inside = slice(rows[0], rows[-1] + 1), rows - rows[0]
            parts.append({name: array[span][inside] for name, array in mapped.items()})
        joined = {name: np.concatenate([p[name] for p in parts]) for name in needed(self.estimates)}
        first = joined.pop("value_a")
        joined["value"] = mean_value(first, joined.pop("value_b", first))
        return TrainingQueries(**{k: torch.from_numpy(v) for k, v in joined.items()}).to(self.device)

    def batches(self, size: int, seed: int, step: int, margin: int = 0) -> Iterator[TrainingQueries]:
        """As :meth:`TrainingQueries.batches`; a thread reads the next batch in the meantime."""
        starts = batch_starts(len(self), size, seed, step)
        with ThreadPoolExecutor(1) as reader:
            first = next(starts)
            waiting = reader.submit(self.slice, first, first + size)
            for start in starts:
                batch = waiting.result()
                waiting = reader.submit(self.slice, start, start + size)
                yield batch

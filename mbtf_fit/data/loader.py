"""Shards in memory: training queries, and what is kept out of training to judge it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_core.shard_schema import Layout, Split
from mbtf_fit.config import HeldOutSection
from mbtf_gen.dataset.reader import Dataset, Shard
from mbtf_gen.dataset.shard_io import Arrays, read_shard

if TYPE_CHECKING:
    from mbtf_fit.data.images import TrainingBuffers
    from mbtf_fit.data.streaming import Selection, StreamedQueries

NEEDED = ("u", "sigma", "omega_i", "omega_o", "value_a", "value_b")


@dataclass(frozen=True)
class Queries:
    """Queries with both estimates of their value, float32 NumPy arrays.

    Buffers of the image layout have (items, rows, columns) in place of n, until :meth:`flat`.

    Attributes
    ----------
    u : (n, 2) uv; sigma : (n,) tile widths; omega_i, omega_o : (n, 3); value_a, value_b : (n, 3) in 1/sr
    """

    u: NDArray[np.float32]
    sigma: NDArray[np.float32]
    omega_i: NDArray[np.float32]
    omega_o: NDArray[np.float32]
    value_a: NDArray[np.float32]
    value_b: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.sigma)

    @classmethod
    def join(cls, parts: Iterable[Queries]) -> Queries:
        """All parts, one after the other."""
        found = list(parts)
        return cls(**{f.name: np.concatenate([getattr(p, f.name) for p in found]) for f in fields(cls)})

    def flat(self) -> Queries:
        """The same queries with one leading axis."""
        lead = self.sigma.ndim
        arrays = {f.name: getattr(self, f.name) for f in fields(self)}
        return Queries(**{name: a.reshape(-1, *a.shape[lead:]) for name, a in arrays.items()})

    def take(self, rows: Any) -> Queries:
        """Some of the queries: a slice, an index array or a mask."""
        return Queries(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


def batch_starts(total: int, size: int, seed: int, step: int) -> Iterator[int]:
    """Number of the first query of each batch of `size` of `total` queries, from a step on, endlessly: every
    epoch all slices in a new order, each epoch's slices from another query on."""
    count = total // size
    while True:
        epoch, done = divmod(step, count)
        random = np.random.Generator(np.random.Philox(key=[seed, epoch]))
        start = int(random.integers(total - count * size + 1))
        for i in random.permutation(count)[done:]:
            yield start + int(i) * size
        step += count - done


def mean_value(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean of both halves; no sum that could overflow."""
    half = np.float32(0.5)
    out: NDArray[np.float32] = half * a + half * b
    return out


@dataclass(frozen=True)
class TrainingQueries:
    """Queries as training reads them: contiguous tensors on the device, value the mean of both halves."""

    u: Tensor
    sigma: Tensor
    omega_i: Tensor
    omega_o: Tensor
    value: Tensor

    def __len__(self) -> int:
        return len(self.sigma)

    def batches(self, size: int, seed: int, step: int, margin: int = 0) -> Iterator[TrainingQueries]:
        """Endless batches of `size` queries from a step on: every epoch all slices in a new order.

        The layout promises queries in random order, so that consecutive ones are a batch. Single queries have
        no `margin`.
        """
        for start in batch_starts(len(self), size, seed, step):
            yield self.slice(start, start + size)

    def numbers(self, size: int, seed: int, step: int) -> list[range]:
        """Numbers of the queries in the batch of a step."""
        start = next(batch_starts(len(self), size, seed, step))
        return [range(start, start + size)]

    def slice(self, start: int, stop: int) -> TrainingQueries:
        """Consecutive queries, without copying."""
        return TrainingQueries(*(getattr(self, f.name)[start:stop] for f in fields(self)))

    def to(self, device: torch.device) -> TrainingQueries:
        """The same queries on another device."""
        return TrainingQueries(*(getattr(self, f.name).to(device) for f in fields(self)))


@dataclass(frozen=True)
class Partition:
    """The train split, divided by :func:`load_training`.

    Attributes
    ----------
    training : what is trained on, in the order of the shards; whole buffers in the image layout; left on disk
        where it does not fit into the memory allowed
    held_out_queries : a random share of the queries outside the held-out region
    held_out_directions : queries with light or view in the held-out region; at most `MAX_HELD_OUT`
    sample : some of what is trained on, with both halves; about `SAMPLE` queries from all shards
    selection : which rows of which shards are trained on: queries, or buffers in the image layout
    """

    training: TrainingQueries | TrainingBuffers | StreamedQueries
    held_out_queries: Queries
    held_out_directions: Queries
    sample: Queries
    selection: Selection


# Bytes of a training query in memory.
QUERY_BYTES = 48
# Training queries that stand for all of them where both halves are wanted.
SAMPLE = 1 << 16
# Held-out queries that are kept for evaluation; the rest of them is dropped, never trained on.
MAX_HELD_OUT = 1 << 16


def open_data(folder: str | Path, layout: Layout, model: str) -> Dataset:
    """Open a folder of shards to train a model that needs a layout.

    Raises
    ------
    InputError : no data set, or of another layout
    """
    data = Dataset.open(folder)
    if data.layout != layout:
        raise InputError(
            f"shards are in the {data.layout} layout, but {model} learns from the {layout} one",
            where=folder,
            hint=f"generate them with: mbtf-gen ... --layout {layout}",
        )
    return data


def data_hash(data: Dataset) -> str:
    """What identifies a data set: the hash that its generator gave it."""
    return str(data.manifest.get("config_hash", ""))


def read_checked(shard: Shard) -> Queries:
    """One shard, every number checked.

    Raises
    ------
    InputError : NaN or infinity, or another number of rows than its sidecar says
    """
    arrays: Arrays = read_shard(shard.path, NEEDED)
    rows = len(arrays["sigma"])
    if rows != shard.rows:
        raise InputError(
            f"shard holds {rows} rows, its sidecar says {shard.rows}",
            where=shard.path,
            hint="look for damage with: mbtf-gen verify",
        )
    for name, array in arrays.items():
        # A sum is finite exactly when no addend is NaN or infinite, short of overflow; look closer only then.
        with np.errstate(all="ignore"):
            suspicious = not np.isfinite(np.sum(array, dtype=np.float64))
        if suspicious and not np.isfinite(array).all():
            bad = np.argwhere(~np.isfinite(array))
            raise InputError(
                f"'{name}' holds NaN or infinite numbers: {len(bad)}, the first in row {bad[0][0]}",
                where=shard.path,
                hint="look for damage with: mbtf-gen verify",
            )
    return Queries(**arrays)


def in_region(held_out: HeldOutSection, omega: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which directions (n, 3) lie in the held-out region, a disk on the projected hemisphere: (n,)."""
    if held_out.radius == 0:
        return np.zeros(len(omega), bool)
    center = np.asarray(held_out.direction, np.float32)
    with np.errstate(over="ignore"):  # of damaged shards
        return ((omega[:, :2] - center) ** 2).sum(1) < np.float32(held_out.radius) ** 2


def _marks(held_out: HeldOutSection, queries: Queries, seed: int, shard: int) -> NDArray[np.int8]:
    """What becomes of each query of a shard: 0 trained on, 1 held-out query, 2 held-out direction."""
    random = np.random.Generator(np.random.Philox(key=[seed, shard])).random(len(queries))
    marks = np.where(random < held_out.queries, np.int8(1), np.int8(0))
    region = in_region(held_out, queries.omega_i) | in_region(held_out, queries.omega_o)
    return np.where(region, np.int8(2), marks)


def load_training(
    data: Dataset, held_out: HeldOutSection, seed: int, memory: float | None = math.inf
) -> Partition:
    """Read the train split and divide it; the division depends on the data and `seed` alone.

    In the image layout whole buffers are held out (:func:`~mbtf_fit.data.images.load_buffers`).

    Parameters
    ----------
    memory : bytes that training queries may take; more are left on disk, and read as batches need them; None
        leaves them there in any case, for who does not train

    Raises
    ------
    InputError : no queries to train on, NaN or infinity in a shard, damaged shards; too many for memory, in
        shards that cannot be mapped
    """
    if data.layout == "image":
        from mbtf_fit.data.images import load_buffers

        return load_buffers(data, held_out, seed)
    from mbtf_fit.data.streaming import Selection, StreamedQueries

    shards = data.shards("train")
    total = sum(shard.rows for shard in shards)
    if total == 0:
        raise InputError(
            "its train split holds no queries", where=data.folder, hint="generate some: --queries"
        )
    streamed = memory is None or total * QUERY_BYTES > memory
    if memory is not None and streamed and any(shard.path.suffix == ".exr" for shard in shards):
        raise InputError(
            f"its {total} queries take {total * QUERY_BYTES / 1e9:.3g} GB, more than data.memory allows, and "
            "EXR shards cannot be read in parts",
            where=data.folder,
            hint="raise data.memory, or generate with: mbtf-gen ... --format npz",
        )
    columns = {"u": (2,), "sigma": (), "omega_i": (3,), "omega_o": (3,), "value": (3,)}
    room = 0 if streamed else total
    store = {name: np.empty((room, *shape), np.float32) for name, shape in columns.items()}
    kept_out: tuple[list[Queries], list[Queries]] = ([], [])
    sample: list[Queries] = []
    selection = Selection()
    for index, shard in enumerate(shards):
        queries = read_checked(shard)
        marks = _marks(held_out, queries, seed, index)
        for group, mark in zip(kept_out, (1, 2), strict=True):
            wanted = MAX_HELD_OUT - sum(map(len, group))
            group.append(queries.take(np.flatnonzero(marks == mark)[:wanted]))
        selection.add(shard.path, marks == 0)
        rows = np.flatnonzero(marks == 0)
        # The layout promises a random order: the first ones are as good as any.
        sample.append(queries.take(rows[: -(-SAMPLE * len(rows) // total)]))
        if streamed:
            continue
        part = slice(selection.starts[-2], selection.starts[-1])
        for name in ("u", "sigma", "omega_i", "omega_o"):
            np.take(getattr(queries, name), rows, axis=0, out=store[name][part], mode="clip")
        store["value"][part] = mean_value(queries.value_a[rows], queries.value_b[rows])
    if len(selection) == 0:
        raise InputError(
            f"all {total} queries of its train split are held out",
            where=data.folder,
            hint="lower held_out.queries and held_out.radius",
        )
    training: TrainingQueries | StreamedQueries
    if streamed:
        training = StreamedQueries(selection)
    else:
        filled = {name: torch.from_numpy(array[: len(selection)]) for name, array in store.items()}
        training = TrainingQueries(**filled)
    joined = [Queries.join(group) for group in (*kept_out, sample)]
    return Partition(training, joined[0], joined[1], joined[2], selection)


def load_split(data: Dataset, split: Split, limit: int | None = None) -> Queries:
    """Queries of a split, or its first `limit`.

    Raises
    ------
    InputError : no such split, no queries in it, NaN or infinity, damaged shards
    """
    parts: list[Queries] = []
    for shard in data.shards(split):
        left = None if limit is None else limit - sum(map(len, parts))
        if left is None or left > 0:
            parts.append(read_checked(shard).flat().take(slice(left)))
    if not parts or not sum(map(len, parts)):
        raise InputError(f"its {split} split holds no queries", where=data.folder)
    return Queries.join(parts)

"""The image layout in memory: whole buffers, and the crops of them that a batch is made of.

A buffer's queries share light, view and footprint. A whole buffer holds one query per texel of the finest
level; a crop takes every d-th row and column of it, d as wide as a texel of the level nearest to the
footprint, so that neighbors in a crop are as far apart as the places that a model of neighborhoods looks
at. Rows and columns wrap around, as the tile does.

A window is a grid of places one texel of that level apart, exactly as a model of neighborhoods looks at
them; a crop is a part of it, and its margin goes on beyond the border.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_core.lattice import Lattice, level_of_sigma
from mbtf_fit.config import HeldOutSection
from mbtf_fit.data.loader import SAMPLE, Partition, Queries, in_region, mean_value, read_checked
from mbtf_fit.data.streaming import Selection
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.shard_io import read_shard

# Held-out queries of each kind: those of a buffer have everything in common but their place, so more say
# little.
HELD_OUT = 1 << 14
# Number of the random stream that decides what is held out; those of batches count up from 0.
_MARKS = 1 << 62


@dataclass(frozen=True)
class Crops:
    """A batch of the image layout.

    Attributes
    ----------
    u : (items, rows+2m, columns+2m, 2) places, with a margin of m on each side
    sigma : (items,); omega_i, omega_o : (items, 3), shared by an item's places
    value : (items, rows, columns, 3) in 1/sr, of the places within the margin
    """

    u: Tensor
    sigma: Tensor
    omega_i: Tensor
    omega_o: Tensor
    value: Tensor

    def __len__(self) -> int:
        return len(self.sigma)

    def slice(self, start: int, stop: int) -> Crops:
        """Consecutive items, without copying."""
        part = slice(start, stop)
        return Crops(self.u[part], self.sigma[part], self.omega_i[part], self.omega_o[part], self.value[part])


def nearest_shapes(lattice: Lattice, sigma: NDArray[np.float32]) -> NDArray[np.int64]:
    """(rows, columns) of the level nearest to footprints (n,): (n, 2)."""
    shapes = np.array([lattice.shape(s) for s in range(lattice.finest + 1)])
    nearest = np.floor(np.clip(level_of_sigma(sigma), 0, lattice.finest) + 0.5).astype(np.int64)
    out: NDArray[np.int64] = shapes[nearest]
    return out


def strides(lattice: Lattice, sigma: NDArray[np.float32]) -> NDArray[np.int64]:
    """(rows, columns) of the finest level per texel of the level nearest to footprints (n,): (n, 2), at least
    1."""
    shape = np.array(lattice.shape())
    return np.maximum(1, np.round(shape / nearest_shapes(lattice, sigma))).astype(np.int64)


@dataclass(frozen=True)
class TrainingBuffers:
    """Buffers as training reads them, value the mean of both halves.

    Attributes
    ----------
    u : (buffers, rows, columns, 2); value : (buffers, rows, columns, 3) in 1/sr
    sigma : (buffers,); omega_i, omega_o : (buffers, 3)
    stride : (buffers, 2) rows and columns between neighbors of a crop
    extent : (buffers, 2) rows and columns of the level that windows lie on; None for whole buffers
    side : places along each side of a batch's crops that are compared with values, at most
    """

    u: Tensor
    sigma: Tensor
    omega_i: Tensor
    omega_o: Tensor
    value: Tensor
    stride: NDArray[np.int64]
    extent: NDArray[np.int64] | None = None
    side: int = 32

    def __len__(self) -> int:
        """Queries in all."""
        return self.u[..., 0].numel()

    def to(self, device: torch.device) -> TrainingBuffers:
        """The same buffers on another device."""
        u, sigma, omega_i, omega_o, value = (
            t.to(device) for t in (self.u, self.sigma, self.omega_i, self.omega_o, self.value)
        )
        return replace(self, u=u, sigma=sigma, omega_i=omega_i, omega_o=omega_o, value=value)

    def crop(self, buffer: NDArray[np.int64], origin: NDArray[np.int64], size: int, margin: int) -> Crops:
        """Crops of `size` × `size` places of buffers (items,), the first place at `origin` (items, 2), row
        and column."""
        rows, columns = self.u.shape[1:3]
        steps = np.arange(-margin, size + margin)
        row, column = (
            (origin[:, axis, None] + self.stride[buffer, axis, None] * steps) % extent
            for axis, extent in enumerate((rows, columns))
        )
        place = (buffer[:, None] * rows + row)[:, :, None] * columns + column[:, None, :]
        at = torch.from_numpy(place).to(self.u.device)
        inner = at[:, margin : margin + size, margin : margin + size]
        chosen = torch.from_numpy(buffer).to(self.u.device)
        if self.extent is None:
            u = self.u.view(-1, 2)[at]
        else:
            u = self._grid(chosen, self.extent[buffer], origin, size, margin)
        return Crops(
            u,
            self.sigma[chosen],
            self.omega_i[chosen],
            self.omega_o[chosen],
            self.value.view(-1, 3)[inner],
        )

    def _grid(
        self, chosen: Tensor, extent: NDArray[np.int64], origin: NDArray[np.int64], size: int, margin: int
    ) -> Tensor:
        """Places (items, size+2·margin, size+2·margin, 2) of crops of windows, beyond their borders too."""
        steps = np.arange(-margin, size + margin)
        down, across = ((origin[:, k, None] + steps) / extent[:, k, None] for k in (0, 1))
        first = self.u[chosen, 0, 0].cpu().numpy().astype(np.float64)
        u, v = first[:, :1] + across, first[:, 1:] - down
        shape = (len(u), len(steps), len(steps))
        grid = np.stack([np.broadcast_to(u[:, None], shape), np.broadcast_to(v[:, :, None], shape)], -1)
        return torch.from_numpy(grid % 1.0).to(self.u)

    def batches(self, size: int, seed: int, step: int, margin: int) -> Iterator[Crops]:
        """Endless batches of at most about `size` queries from a step on: crops of buffers, each buffer once
        before any comes twice."""
        rows, columns = self.u.shape[1:3]
        while True:
            buffer, side = self._chosen(size, seed, step)
            if self.extent is not None:
                rows, columns = (n - side + 1 for n in self.u.shape[1:3])
            origin = _philox(seed, 2 * step + 1).integers(0, (rows, columns), (len(buffer), 2))
            yield self.crop(buffer, origin, side, margin)
            step += 1

    def _chosen(self, size: int, seed: int, step: int) -> tuple[NDArray[np.int64], int]:
        """(buffers of a batch, places along each side of its crops)."""
        count, rows, columns = self.u.shape[:3]
        side = min(self.side, rows, columns, max(1, round(size**0.5)))
        items = max(1, size // side**2)
        places = np.arange(step * items, (step + 1) * items)
        sweeps, position = np.divmod(places, count)
        order = {int(s): _philox(seed, 2 * int(s)).permutation(count) for s in np.unique(sweeps)}
        return np.array([order[int(s)][p] for s, p in zip(sweeps, position, strict=True)]), side

    def numbers(self, size: int, seed: int, step: int) -> list[range]:
        """Numbers of the buffers that the batch of a step is cut from."""
        return [range(k, k + 1) for k in sorted(set(self._chosen(size, seed, step)[0].tolist()))]


def _philox(seed: int, stream: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key=[seed, stream]))


def _some(buffers: Queries, places: int, random: np.random.Generator) -> Queries:
    """At most `places` queries of buffers, equally many of each, in random order."""
    count, rows, columns = buffers.sigma.shape
    if count == 0:
        return buffers.flat()
    each = min(rows * columns, -(-places // count))
    chosen = [k * rows * columns + random.permutation(rows * columns)[:each] for k in range(count)]
    return buffers.flat().take(random.permutation(np.concatenate(chosen))[:places])


def _marks(data: Dataset, held_out: HeldOutSection, random: np.random.Generator) -> NDArray[np.int8]:
    """What becomes of each buffer: 0 trained on, 1 held-out query, 2 held-out direction. Where queries are
    held out at all, that is one buffer at least."""
    parts = []
    for shard in data.shards("train"):
        arrays = read_shard(shard.path, ("omega_i", "omega_o"))
        light, view = (np.array(arrays[name][:, 0, 0]) for name in ("omega_i", "omega_o"))
        parts.append(in_region(held_out, light) | in_region(held_out, view))
    marks = np.where(np.concatenate(parts), np.int8(2), np.int8(0))
    inside = np.flatnonzero(marks == 0)
    count = max(1, round(held_out.queries * len(inside))) if held_out.queries and len(inside) > 1 else 0
    marks[random.permutation(inside)[:count]] = 1
    return marks


def load_buffers(data: Dataset, held_out: HeldOutSection, seed: int) -> Partition:
    """Read the train split of the image layout and divide it by buffers; held-out queries come from all of
    the buffers that are kept out.

    Raises
    ------
    InputError : no buffers to train on, NaN or infinity in a shard, damaged shards
    """
    shards = data.shards("train")
    total = sum(shard.rows for shard in shards)
    if total == 0:
        raise InputError(
            "its train split holds no queries", where=data.folder, hint="generate some: --queries"
        )
    random = _philox(seed, _MARKS)
    marks = _marks(data, held_out, random)
    count = int((marks == 0).sum())
    if count == 0:
        raise InputError(
            f"all {total} buffers of its train split are held out",
            where=data.folder,
            hint="lower held_out.queries and held_out.radius",
        )
    window = data.patch_size
    shape = (count, *(data.lattice.shape() if window is None else (window, window)))
    u, value = np.empty((*shape, 2), np.float32), np.empty((*shape, 3), np.float32)
    sigma, omega = np.empty(count, np.float32), np.empty((2, count, 3), np.float32)
    out: tuple[list[Queries], list[Queries]] = ([], [])
    sample: list[Queries] = []
    selection = Selection()
    read = filled = 0
    for shard in shards:
        buffers = read_checked(shard)
        mine = marks[read : read + len(buffers)]
        read += len(buffers)
        for group, mark in zip(out, (1, 2), strict=True):
            group.append(buffers.take(np.flatnonzero(mine == mark)))
        kept = np.flatnonzero(mine == 0)
        selection.add(shard.path, mine == 0)
        sample.append(_some(buffers.take(kept), -(-SAMPLE * len(kept) // count), random))
        part = slice(filled, filled + len(kept))
        u[part], sigma[part] = buffers.u[kept], buffers.sigma[kept, 0, 0]
        omega[0, part], omega[1, part] = buffers.omega_i[kept, 0, 0], buffers.omega_o[kept, 0, 0]
        value[part] = mean_value(buffers.value_a[kept], buffers.value_b[kept])
        filled += len(kept)
    training = TrainingBuffers(
        torch.from_numpy(u),
        torch.from_numpy(sigma),
        torch.from_numpy(omega[0]),
        torch.from_numpy(omega[1]),
        torch.from_numpy(value),
        strides(data.lattice, sigma) if window is None else np.ones((count, 2), np.int64),
        None if window is None else nearest_shapes(data.lattice, sigma),
    )
    kept_out = [_some(Queries.join(group), HELD_OUT, random) for group in out]
    return Partition(training, kept_out[0], kept_out[1], Queries.join(sample), selection)

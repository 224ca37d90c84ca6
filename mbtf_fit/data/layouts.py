"""The layouts of images and of slices in memory, and their batches.

Slices are the values of every texel at the same lights and views.

The queries of an image share light, view and footprint. A full image has one query per texel of the finest
level. A patch takes every d-th row and column of it, where d texels are as wide as one texel of the level
nearest to the footprint: that is the spacing of the samples that the inception decoder reads. Rows and
columns wrap around, as the tile does.

An image of limited size is a grid of positions one texel of that level apart. Patches lie inside it; their
margins extend beyond its border.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.data.lattice import Lattice, level_of_sigma, texel_centers
from mbtf_fit.data.queries import TrainingQueries


def philox(seed: int, stream: int) -> np.random.Generator:
    """Generator of a numbered random stream."""
    return np.random.Generator(np.random.Philox(key=[seed, stream]))


@lru_cache(maxsize=4)
def _order(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    """Order in which an epoch visits the images."""
    return philox(seed, 2 * epoch).permutation(count)


@dataclass(frozen=True)
class Patches:
    """A batch of the image layout.

    Attributes
    ----------
    u : (items, rows+2m, columns+2m, 2) positions, with a margin of m on each side
    sigma : (items,); omega_i, omega_o : (items, 3), shared by the positions of an item
    value : (items, rows, columns, 3) in 1/sr, without the margin
    """

    u: Tensor
    sigma: Tensor
    omega_i: Tensor
    omega_o: Tensor
    value: Tensor

    def __len__(self) -> int:
        return len(self.sigma)

    def slice(self, start: int, stop: int) -> Patches:
        """Consecutive items, without a copy."""
        return Patches(*(getattr(self, f.name)[start:stop] for f in fields(self)))


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
class TrainingImages:
    """Images for training; the value is the mean of both halves.

    Attributes
    ----------
    u : (images, rows, columns, 2); value : (images, rows, columns, 3) in 1/sr
    sigma : (images,); omega_i, omega_o : (images, 3)
    stride : (images, 2) rows and columns between the samples of a patch
    extent : (images, 2) rows and columns of the level whose texels the positions follow; None for full images
    patch_size : largest width and height of a batch's patches, without the margin
    """

    u: Tensor
    sigma: Tensor
    omega_i: Tensor
    omega_o: Tensor
    value: Tensor
    stride: NDArray[np.int64]
    extent: NDArray[np.int64] | None = None
    patch_size: int = 32

    def __len__(self) -> int:
        """Number of queries."""
        return self.u[..., 0].numel()

    def to(self, device: torch.device) -> TrainingImages:
        """The same images on another device."""
        names = ("u", "sigma", "omega_i", "omega_o", "value")
        return replace(self, **{name: getattr(self, name).to(device) for name in names})

    def patches(self, image: NDArray[np.int64], origin: NDArray[np.int64], size: int, margin: int) -> Patches:
        """Patches of `size` × `size` samples of images (items,) with the first sample at `origin` (items, 2),
        row and column."""
        chosen = torch.from_numpy(image).to(self.u.device)
        at = self._index(image, origin, np.arange(size))
        if self.extent is None:
            u = self.u.view(-1, 2)[self._index(image, origin, np.arange(-margin, size + margin))]
        else:
            u = self._grid(chosen, self.extent[image], origin, size, margin)
        return Patches(
            u, self.sigma[chosen], self.omega_i[chosen], self.omega_o[chosen], self.value.view(-1, 3)[at]
        )

    def _index(self, image: NDArray[np.int64], origin: NDArray[np.int64], steps: NDArray[np.int64]) -> Tensor:
        """Numbers (items, steps, steps) of the queries of images, so many samples from `origin`."""
        rows, columns = self.u.shape[1:3]
        row, column = (
            (origin[:, axis, None] + self.stride[image, axis, None] * steps) % extent
            for axis, extent in enumerate((rows, columns))
        )
        index = (image[:, None] * rows + row)[:, :, None] * columns + column[:, None, :]
        return torch.from_numpy(index).to(self.u.device)

    def _grid(
        self, chosen: Tensor, extent: NDArray[np.int64], origin: NDArray[np.int64], size: int, margin: int
    ) -> Tensor:
        """Positions (items, size+2·margin, size+2·margin, 2) of patches, also beyond the image's border."""
        steps = np.arange(-margin, size + margin)
        down, across = ((origin[:, k, None] + steps) / extent[:, k, None] for k in (0, 1))
        first = self.u[chosen, 0, 0].cpu().numpy().astype(np.float64)
        grid = np.empty((len(first), len(steps), len(steps), 2), np.float32)
        grid[..., 0] = ((first[:, :1] + across) % 1.0)[:, None]
        grid[..., 1] = ((first[:, 1:] - down) % 1.0)[:, :, None]
        return torch.from_numpy(grid).to(self.u)

    def batches(self, size: int, seed: int, step: int, margin: int) -> Iterator[Patches]:
        """Endless batches of at most about `size` queries from a step on; every epoch visits each image
        once."""
        rows, columns = self.u.shape[1:3]
        while True:
            image, side = self._chosen(size, seed, step)
            if self.extent is not None:
                rows, columns = (n - side + 1 for n in self.u.shape[1:3])
            origin = philox(seed, 2 * step + 1).integers(0, (rows, columns), (len(image), 2))
            yield self.patches(image, origin, side, margin)
            step += 1

    def _chosen(self, size: int, seed: int, step: int) -> tuple[NDArray[np.int64], int]:
        """(images of a batch, width of its patches)."""
        count, rows, columns = self.u.shape[:3]
        side = min(self.patch_size, rows, columns, max(1, round(size**0.5)))
        items = max(1, size // side**2)
        epochs, position = np.divmod(np.arange(step * items, (step + 1) * items), count)
        order = {int(s): _order(seed, int(s), count) for s in np.unique(epochs)}
        return np.array([order[int(s)][p] for s, p in zip(epochs, position, strict=True)]), side


# Random stream of the order of slices as queries; the streams of batches count up from 0.
ORDER_STREAM = 1 << 61
# Pairs of light and view per texel: that a batch decodes, and that encoders of sets read.
DECODED, READ = 64, 128


@dataclass(frozen=True)
class SliceBatch:
    """Whole slices of some texels, and some pairs of light and view to decode.

    Attributes
    ----------
    values : (items, D, 3) in 1/sr, at all pairs of light and view
    omega_i, omega_o : (D, 3)
    chosen : (items, K) numbers of the pairs to decode
    read : (R,) numbers of the pairs that an encoder of sets reads
    sigma : footprint in tile widths
    """

    values: Tensor
    omega_i: Tensor
    omega_o: Tensor
    chosen: Tensor
    read: Tensor
    sigma: float

    def __len__(self) -> int:
        return len(self.chosen)

    def slice(self, start: int, stop: int) -> SliceBatch:
        """Consecutive items, without a copy."""
        return replace(self, values=self.values[start:stop], chosen=self.chosen[start:stop])

    def queries(self) -> TrainingQueries:
        """The queries to decode, (items · K): positions are not known."""
        pair = self.chosen.flatten()
        value = self.values.gather(1, self.chosen[..., None].expand(-1, -1, 3)).flatten(0, 1)
        sigma = value.new_full((len(pair),), self.sigma)
        return TrainingQueries(
            value.new_zeros(len(pair), 2), sigma, self.omega_i[pair], self.omega_o[pair], value
        )


@dataclass(frozen=True)
class TrainingSlices:
    """The slices of all texels of the finest level; the value is the mean of both halves.

    Attributes
    ----------
    values : (texels, D, 3) in 1/sr, texels in row-major order
    omega_i, omega_o : (D, 3)
    sigma : footprint in tile widths
    """

    values: Tensor
    omega_i: Tensor
    omega_o: Tensor
    sigma: float

    def __len__(self) -> int:
        """Number of queries."""
        return self.values.shape[0] * self.values.shape[1]

    def to(self, device: torch.device) -> TrainingSlices:
        """The same slices on another device."""
        moved = {f.name: getattr(self, f.name).to(device) for f in fields(self) if f.name != "sigma"}
        return replace(self, **moved)

    def scaled(self, factor: float) -> TrainingSlices:
        """The same slices with all values multiplied."""
        return replace(self, values=self.values * factor)

    def as_queries(self, lattice: Lattice, seed: int) -> TrainingQueries:
        """All values as queries at the centers of the texels, in random order."""
        pairs = self.values.shape[1]
        order = torch.from_numpy(philox(seed, ORDER_STREAM).permutation(len(self)))
        texel, pair = order // pairs, order % pairs
        u = torch.from_numpy(texel_centers(*lattice.shape()).astype(np.float32)).view(-1, 2)
        sigma = torch.full((len(self),), self.sigma)
        value = self.values.flatten(0, 1)[order]
        return TrainingQueries(u[texel], sigma, self.omega_i[pair], self.omega_o[pair], value)

    def _texels(self, size: int, seed: int, step: int) -> NDArray[np.int64]:
        """Texels of the batch of a step, at random."""
        decoded = min(DECODED, self.values.shape[1])
        count = min(max(1, size // decoded), len(self.values))
        return philox(seed, step).choice(len(self.values), count, replace=False)

    def batch(self, size: int, seed: int, step: int) -> SliceBatch:
        """About `size` queries to decode: :data:`DECODED` of each of some texels."""
        texels = torch.from_numpy(self._texels(size, seed, step)).to(self.values.device)
        pairs = self.values.shape[1]
        random = torch.Generator().manual_seed((seed * 1_000_003 + step) % (1 << 63))
        chosen = torch.randint(pairs, (len(texels), min(DECODED, pairs)), generator=random)
        read = torch.randperm(pairs, generator=random)[:READ]
        chosen, read = (part.to(self.values.device) for part in (chosen, read))
        return SliceBatch(self.values[texels], self.omega_i, self.omega_o, chosen, read, self.sigma)

    def batches(self, size: int, seed: int, step: int, margin: int = 0) -> Iterator[SliceBatch]:
        """Endless batches from a step on; `margin` is unused."""
        while True:
            yield self.batch(size, seed, step)
            step += 1


@dataclass(frozen=True)
class SharedSlices:
    """Slices of several materials, which batches take in turn.

    Attributes
    ----------
    own : of the material that is fitted
    learned : of the materials that the network learns
    """

    own: TrainingSlices
    learned: Sequence[TrainingSlices]

    def __len__(self) -> int:
        return sum(map(len, self.learned))

    def batches(self, size: int, seed: int, step: int, margin: int = 0) -> Iterator[SliceBatch]:
        """Endless batches from a step on; `margin` is unused."""
        while True:
            yield self.learned[step % len(self.learned)].batch(size, seed, step)
            step += 1

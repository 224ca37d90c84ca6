"""The slices layout in memory: the values of every texel at the same lights and views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_fit.data.images import philox
from mbtf_fit.data.queries import TrainingQueries

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

"""Queries of a data set as NumPy arrays and as tensors, and the order of the batches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# Arrays of a shard that the fitter reads.
NEEDED = ("u", "sigma", "omega_i", "omega_o", "value_a", "value_b")
# Bytes of a training query in memory.
QUERY_BYTES = 48


def needed(estimates: int, weighted: bool = False) -> tuple[str, ...]:
    """Arrays of shards with so many estimates of every value, and with weights or none."""
    names = NEEDED if estimates == 2 else tuple(name for name in NEEDED if name != "value_b")
    return (*names, "weight") if weighted else names


@dataclass(frozen=True)
class ShardQueries:
    """Queries with both estimates of their value, float32 NumPy arrays. Measured data have one, which then
    stands for both: their errors include its noise.

    Images of the image layout have (items, rows, columns) in place of n, until :meth:`flat`.

    Attributes
    ----------
    u : (n, 2) uv; sigma : (n,) tile widths; omega_i, omega_o : (n, 3); value_a, value_b : (n, 3) in 1/sr
    weight : (n,) weights in means over queries; None where all are 1
    group : (n,) labels of groups that share paths; None where each query has its own
    """

    u: NDArray[np.float32]
    sigma: NDArray[np.float32]
    omega_i: NDArray[np.float32]
    omega_o: NDArray[np.float32]
    value_a: NDArray[np.float32]
    value_b: NDArray[np.float32]
    weight: NDArray[np.float32] | None = None
    group: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.sigma)

    @property
    def halves(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any] | None, NDArray[Any] | None]:
        """Both estimates, weights and groups, as statistics of :mod:`mbtf_core.stats` take them."""
        return self.value_a, self.value_b, self.weight, self.group

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> ShardQueries:
        """Queries of the arrays of a shard."""
        return cls(**{"value_b": arrays["value_a"], **arrays})

    @classmethod
    def join(cls, parts: Iterable[ShardQueries]) -> ShardQueries:
        """Concatenation of all parts."""
        found = [part._arrays() for part in parts]
        return cls(**{name: np.concatenate([arrays[name] for arrays in found]) for name in found[0]})

    def flat(self) -> ShardQueries:
        """The same queries with one leading axis."""
        lead = self.sigma.ndim
        return ShardQueries(**{name: a.reshape(-1, *a.shape[lead:]) for name, a in self._arrays().items()})

    def take(self, rows: Any) -> ShardQueries:
        """Some of the queries: a slice, an index array or a mask."""
        return ShardQueries(**{name: a[rows] for name, a in self._arrays().items()})

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {name: array for name, array in vars(self).items() if array is not None}


def batch_starts(total: int, size: int, seed: int, step: int) -> Iterator[int]:
    """Endless indices of the first query of each batch of `size` of `total` queries, from a step on.

    Every epoch visits all batches in a new order, and starts its batches at another query.
    """
    count = total // size
    while True:
        epoch, done = divmod(step, count)
        random = np.random.Generator(np.random.Philox(key=[seed, epoch]))
        start = int(random.integers(total - count * size + 1))
        for i in random.permutation(count)[done:]:
            yield start + int(i) * size
        step += count - done


def mean_value(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean of both halves, without overflow."""
    half = np.float32(0.5)
    out: NDArray[np.float32] = half * a + half * b
    return out


@dataclass(frozen=True)
class TrainingQueries:
    """Queries for training: contiguous tensors on the device; the value is the mean of both halves. Models of
    a known surface have :mod:`hints <mbtf_fit.surface.known>`."""

    u: Tensor
    sigma: Tensor
    omega_i: Tensor
    omega_o: Tensor
    value: Tensor
    hints: Tensor | None = None

    def __len__(self) -> int:
        return len(self.sigma)

    def batches(self, size: int, seed: int, step: int, margin: int = 0) -> Iterator[TrainingQueries]:
        """Endless batches of `size` queries from a step on; `margin` is unused.

        The shards store queries in random order, so consecutive queries form a batch.
        """
        for start in batch_starts(len(self), size, seed, step):
            yield self.slice(start, start + size)

    def slice(self, start: int, stop: int) -> TrainingQueries:
        """Consecutive queries, without a copy."""
        return self._each(lambda a: a[start:stop])

    def to(self, device: torch.device) -> TrainingQueries:
        """The same queries on another device."""
        return self._each(lambda a: a.to(device))

    def _each(self, function: Callable[[Tensor], Tensor]) -> TrainingQueries:
        u, sigma, omega_i, omega_o, value = map(
            function, (self.u, self.sigma, self.omega_i, self.omega_o, self.value)
        )
        hints = None if self.hints is None else function(self.hints)
        return TrainingQueries(u, sigma, omega_i, omega_o, value, hints)

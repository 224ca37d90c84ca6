"""Gradients of one batch, computed by several threads, each on its own share of the queries.

A step consists of some hundred small operations. Splitting every one of them over the cores costs a
rendezvous each, and where another process holds a core for a moment, all wait for it each time. Splitting the
batch instead costs one rendezvous per step, and the parts that libraries run on one core run side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from types import TracebackType
from typing import Any, TypeVar

import torch
from torch import Tensor

from mbtf_fit.data.images import Crops
from mbtf_fit.data.loader import TrainingQueries

# Python itself is busy for a part of each step, and one thread at a time: more than these do not pay.
MAX_THREADS = 4
# The kernel leaves the interpreter alone; its threads have sums of gradients each.
MAX_KERNEL_THREADS = 32

T = TypeVar("T")

Batch = TrainingQueries | Crops
Loss = Callable[[Any], Tensor]


class Workers:
    """Threads that share batches; use as a context manager.

    Parameters
    ----------
    device : on CUDA one thread does it all
    threads : at most so many; by default as many as cores
    limit : no more than these in any case
    """

    def __init__(self, device: torch.device, threads: int | None = None, *, limit: int | None = None) -> None:
        self._cores = torch.get_num_threads()
        self._precision = torch.get_float32_matmul_precision()
        most = MAX_THREADS if limit is None else limit
        self.count = 1 if device.type == "cuda" else min(threads or self._cores, most)
        self._pool = ThreadPoolExecutor(self.count) if self.count > 1 else None

    def __enter__(self) -> Workers:
        # Lets the library choose among its matrix products: for matrices this narrow the one it then takes is
        # twice as fast. Processors with bfloat16 tiles may round factors to 8 bits, which training tolerates.
        torch.set_float32_matmul_precision("medium")
        torch.set_num_threads(max(1, self._cores // self.count))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown()
        torch.set_num_threads(self._cores)
        torch.set_float32_matmul_precision(self._precision)

    def each(self, work: Callable[[int], T]) -> list[T]:
        """``work(k)`` for every thread k, run side by side; answers in this order."""
        parts = range(self.count)
        return list(map(work, parts) if self._pool is None else self._pool.map(work, parts))

    def gradients(self, loss: Loss, batch: Batch, inputs: Sequence[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """Mean loss of a batch, and its gradients by `inputs`.

        Parameters
        ----------
        loss : mean over the queries that it is given; called from several threads at a time
        """
        n = len(batch)
        edges = [n * k // self.count for k in range(self.count + 1)]
        parts: list[Batch] = [batch.slice(a, b) for a, b in pairwise(edges) if b > a]

        def work(part: Batch) -> tuple[Tensor, tuple[Tensor, ...]]:
            value = loss(part) * (len(part) / n)
            return value.detach(), torch.autograd.grad(value, inputs)

        found = list(map(work, parts) if self._pool is None else self._pool.map(work, parts))
        # Always added in the same order: the sum does not depend on who was first.
        total, gradients = found[0][0], list(found[0][1])
        for value, more in found[1:]:
            total = total + value
            for mine, other in zip(gradients, more, strict=True):
                mine += other
        return total, gradients

"""Gradients of one batch by several threads, each on a part of the queries.

A step consists of some hundred small operations. Parallelizing each of them costs a synchronization each, and
waits for every core that another process uses. Dividing the batch costs one synchronization per step, and
runs single-threaded operations in parallel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from types import TracebackType
from typing import Any, TypeVar

import torch
from torch import Tensor

from mbtf_fit.data.images import Patches
from mbtf_fit.data.queries import TrainingQueries

# Python code runs in one thread at a time: more threads are not faster.
MAX_THREADS = 4
# The kernel releases the interpreter's lock; each of its threads has sums of gradients.
MAX_KERNEL_THREADS = 32

T = TypeVar("T")

Batch = TrainingQueries | Patches
Loss = Callable[[Any], Tensor]


class Workers:
    """Threads that divide batches; a context manager.

    Parameters
    ----------
    device : CUDA uses one thread
    threads : number of threads; by default that of cores
    limit : most threads
    """

    def __init__(self, device: torch.device, threads: int | None = None, *, limit: int | None = None) -> None:
        self._cores = torch.get_num_threads()
        self._precision = torch.get_float32_matmul_precision()
        most = MAX_THREADS if limit is None else limit
        self.count = 1 if device.type == "cuda" else min(threads or self._cores, most)
        self._pool = ThreadPoolExecutor(self.count) if self.count > 1 else None

    def __enter__(self) -> Workers:
        # Allows faster matrix products, twice as fast for narrow matrices. Processors with bfloat16 tiles may
        # round factors to 8 bits, which training tolerates.
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
        """Results of ``work(k)`` for every thread k, in this order."""
        parts = range(self.count)
        return list(map(work, parts) if self._pool is None else self._pool.map(work, parts))

    def gradients(self, loss: Loss, batch: Batch, inputs: Sequence[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """Mean loss of a batch, and its gradients by `inputs`.

        Parameters
        ----------
        loss : mean over the queries of its argument; called from several threads
        """
        n = len(batch)
        edges = [n * k // self.count for k in range(self.count + 1)]
        parts: list[Batch] = [batch.slice(a, b) for a, b in pairwise(edges) if b > a]

        def work(part: Batch) -> tuple[Tensor, tuple[Tensor, ...]]:
            value = loss(part) * (len(part) / n)
            return value.detach(), torch.autograd.grad(value, inputs)

        found = list(map(work, parts) if self._pool is None else self._pool.map(work, parts))
        # Added in a fixed order: the sum does not depend on which thread finishes first.
        total, gradients = found[0][0], list(found[0][1])
        for value, more in found[1:]:
            total = total + value
            for mine, other in zip(gradients, more, strict=True):
                mine += other
        return total, gradients

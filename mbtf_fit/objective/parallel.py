"""Gradients of one batch by several threads, each on a part of the queries.

A step consists of some hundred small operations. Parallelizing each of them costs a synchronization each, and
waits for every core that another process uses. Dividing the batch costs one synchronization per step, and
runs single-threaded operations in parallel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor

from mbtf_fit.data.layouts import Patches, SliceBatch
from mbtf_fit.data.queries import TrainingQueries

# Python code runs in one thread at a time: more threads are not faster.
MAX_THREADS = 4
# The kernel releases the interpreter's lock; each of its threads has sums of gradients.
MAX_KERNEL_THREADS = 32

T = TypeVar("T")

Batch = TrainingQueries | Patches | SliceBatch
Loss = Callable[[Any], Tensor]


class Workers:
    """Threads that divide batches; a context manager.

    Parameters
    ----------
    device : CUDA uses one thread
    threads : number of threads; by default that of cores
    limit : most threads
    """

    def __init__(self, device: torch.device, threads: int | None = None, *, limit: int = MAX_THREADS) -> None:
        self._cores = torch.get_num_threads()
        self._precision = torch.get_float32_matmul_precision()
        self.count = 1 if device.type == "cuda" else min(threads or self._cores, limit)
        self._pool = ThreadPoolExecutor(self.count) if self.count > 1 else None

    def __enter__(self) -> Workers:
        # Allows faster matrix products, twice as fast for narrow matrices. Processors with bfloat16 tiles may
        # round factors to 8 bits, which training tolerates.
        torch.set_float32_matmul_precision("medium")
        torch.set_num_threads(max(1, self._cores // self.count))
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()
        torch.set_num_threads(self._cores)
        torch.set_float32_matmul_precision(self._precision)

    def each(self, work: Callable[[Any], T], parts: Iterable[Any] | None = None) -> list[T]:
        """Results of ``work(part)``, in this order; by default for the number of every thread."""
        parts = range(self.count) if parts is None else parts
        return list(map(work, parts) if self._pool is None else self._pool.map(work, parts))

    def gradients(self, loss: Loss, batch: Batch, inputs: Sequence[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """Mean loss of a batch, and its gradients by `inputs`; `loss` is called from several threads."""
        n = len(batch)
        edges = [n * k // self.count for k in range(self.count + 1)]
        parts = [batch.slice(a, b) for a, b in pairwise(edges) if b > a]

        def work(part: Batch) -> tuple[Tensor, tuple[Tensor, ...]]:
            value = loss(part) * (len(part) / n)
            return value.detach(), torch.autograd.grad(value, inputs)

        found = self.each(work, parts)
        # Added in a fixed order: the sum does not depend on which thread finishes first.
        (total, gradients), *rest = found
        for value, more in rest:
            total = total + value
            for mine, other in zip(gradients, more, strict=True):
                mine += other
        return total, [*gradients]

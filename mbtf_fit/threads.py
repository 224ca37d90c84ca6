"""Threads of PyTorch's operations."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread_each() -> Iterator[int]:
    """One thread per operation, as small ones lose time waiting: for each other, or for cores that another
    process uses. Yields the number of threads that operations had before."""
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield count
    finally:
        torch.set_num_threads(count)

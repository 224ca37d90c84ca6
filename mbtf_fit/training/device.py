"""The device that trains, and how the process keeps its memory."""

from __future__ import annotations

import contextlib
import ctypes
import sys

import torch

from mbtf_core.errors import EngineError
from mbtf_core.run.task import worker_threads

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def choose_device(name: str) -> torch.device:
    """The device to train on; ``auto`` is CUDA if available. A worker trains with its threads."""
    if (threads := worker_threads()) is not None:
        torch.set_num_threads(threads)
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise EngineError(
            "no CUDA device is available", where="--device cuda", hint="use --device cpu or auto"
        )
    return torch.device("cuda" if available and name != "cpu" else "cpu")


def keep_freed_memory() -> None:
    """Let glibc keep freed blocks of up to 32 MiB instead of returning them to the kernel.

    A training step frees and allocates the same few megabytes; page faults would cost as much as the
    arithmetic.
    """
    if sys.platform != "linux":
        return
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_THRESHOLD, 1 << 25)
        library.mallopt(_M_TRIM_THRESHOLD, 1 << 30)

"""Tasks for tests of clusters; workers import them by name."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from mbtf_core.errors import InputError, PartialError


def double(x: int) -> int:
    """Twice a number."""
    return 2 * x


def fail(kind: str) -> None:
    """Fail in some way."""
    if kind == "input":
        raise InputError("is not there", where="map.png")
    if kind == "partial":
        raise PartialError("the disk is full")
    if kind == "bug":
        raise ZeroDivisionError("a bug")
    os.kill(os.getpid(), signal.SIGKILL)


def die_at_first(marks: str, times: int) -> int:
    """Kill the worker at the first calls; then return how often it was called."""
    calls = len(list(Path(marks).iterdir())) + 1
    (Path(marks) / f"call-{time.time_ns()}").touch()
    if calls <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return calls


def threads() -> tuple[int | None, str | None]:
    """Threads that the worker states."""
    from mbtf_core.cluster.task import worker_threads

    return worker_threads(), os.environ.get("OMP_NUM_THREADS")

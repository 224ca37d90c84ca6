"""Tasks for tests of runners; workers import them."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Generator
from pathlib import Path

from mbtf_core.errors import InputError, LockedError, PartialError


def double(x: int) -> int:
    """Twice a number."""
    return 2 * x


def fail(kind: str) -> None:
    """Fail in some way."""
    if kind == "input":
        raise InputError("is not there", where="map.png")
    if kind == "partial":
        raise PartialError("the disk is full", hint="make room")
    if kind == "bug":
        raise ZeroDivisionError("a bug")
    if kind != "none":
        os.kill(os.getpid(), signal.SIGKILL)


def _called(marks: str) -> int:
    """How often a task was called, this call included."""
    calls = len(list(Path(marks).iterdir())) + 1
    (Path(marks) / f"call-{time.time_ns()}").touch()
    return calls


def die_at_first(marks: str, times: int) -> int:
    """Kill the worker at the first calls; then return how often it was called."""
    calls = _called(marks)
    if calls <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return calls


def fail_at_first(marks: str, times: int) -> int:
    """Fail at the first calls by a bug; then return how often it was called."""
    calls = _called(marks)
    if calls <= times:
        raise ZeroDivisionError("a bug")
    return calls


def locked_at_first(marks: str, times: int) -> int:
    """Meet a lock at the first calls; then return how often it was called."""
    calls = _called(marks)
    if calls <= times:
        raise LockedError("is being written by another process", where="folder")
    return calls


_running = 0


def alone() -> bool:
    """Whether no other task runs in this process meanwhile."""
    global _running
    _running += 1
    time.sleep(0.02)
    alone = _running == 1
    _running -= 1
    return alone


def wait_long(mark: str) -> None:
    """Write the number of this process to a file, and work for long."""
    part = Path(f"{mark}.part")
    part.write_text(str(os.getpid()))
    part.rename(mark)
    time.sleep(600.0)


def in_parts(x: int, folder: str) -> Generator[None, None, int]:
    """Three parts, which write their thread and whether the previous item is behind them."""
    if x == 1:
        return -1
    (Path(folder) / f"first-{x}").write_text(threading.current_thread().name)
    try:
        yield
        (Path(folder) / f"second-{x}").write_text(threading.current_thread().name)
        if x == 3:
            raise PartialError("the disk is full")
        if x == 5:
            raise KeyboardInterrupt
        yield
        (Path(folder) / f"third-{x}").write_text(threading.current_thread().name)
        return x
    finally:
        (Path(folder) / f"closed-{x}").touch()

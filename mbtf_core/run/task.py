"""A task is a function of ours: what it is called with, how it ended, and how a worker runs it.

It may be called more than once with the same arguments, so it is idempotent: what it writes is absent or
complete, and it does nothing where that is done. A task may be a generator with two ``yield``: this process
then does the first part ahead, and the last one behind, while the middle parts of other items run. Its value
is what it returns.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import socket
import threading
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mbtf_core.errors import LockedError, MbtfError, PartialError, reason

# Environment variable with the threads of a worker.
THREADS_VARIABLE = "MBTF_WORKER_THREADS"
# GPUs of each worker of this machine.
GPUS_VARIABLE = "MBTF_WORKER_GPUS"
# Neither a renderer nor the working folder can be shared by the threads of a worker.
_ALONE = threading.Lock()

TaskFunction = Callable[..., Any]


@dataclass(frozen=True)
class Item:
    """One call of a task.

    Attributes
    ----------
    name : for messages; unique in its run
    arguments : keyword arguments; values that can be pickled
    gpu : whether it takes a GPU of its worker
    """

    name: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    gpu: bool = False


@dataclass(frozen=True)
class Result:
    """How an item ended.

    Attributes
    ----------
    name : of the item
    value : what the function returned; None where it failed
    error : why it failed, in one line; empty where it did not
    hint : what to do about it, where that is known
    fatal : the others fail for the same reason, such as files that a worker cannot read
    locked : another process works on the same files
    worker : machine and process; empty for this process
    """

    name: str
    value: Any = None
    error: str = ""
    hint: str = ""
    fatal: bool = False
    locked: bool = False
    worker: str = ""

    @property
    def message(self) -> str:
        """The error, and its hint on a second line."""
        return f"{self.error}\n  {self.hint}" if self.hint else self.error


def failure(error: MbtfError) -> dict[str, Any]:
    """The fields of a :class:`Result` that an error of a task sets."""
    text = f"{error.where}: {error.what}" if error.where else error.what
    fatal, locked = not isinstance(error, PartialError), isinstance(error, LockedError)
    return {"error": text, "hint": error.hint, "fatal": fatal, "locked": locked}


@cache
def _version() -> str:
    """Of this package; reading it takes longer than to submit a task."""
    return version("mbtf")


def packed(function: TaskFunction, item: Item) -> tuple[bytes, str, str]:
    """Arguments of :func:`run_task` for an item: the call, the version of this package, the working
    folder."""
    return pickle.dumps((function, dict(item.arguments))), _version(), os.getcwd()


def run_task(call: bytes, expected: str, folder: str) -> dict[str, Any]:
    """Run a task on a worker, with the arguments that :func:`packed` made, in the working folder where this
    machine has it; returns the fields of :class:`Result` except for the name."""
    worker = {"worker": f"{socket.gethostname()}:{os.getpid()}"}
    installed = _version()
    if installed != expected:
        error = f"the worker has version {installed} of mbtf, the command {expected}"
        return {"error": error, "hint": "install the same version on every machine", "fatal": True, **worker}
    there = Path(folder).is_dir()
    with _ALONE, contextlib.chdir(folder) if there else contextlib.nullcontext():
        try:
            # Unpickling may load the files of a material.
            function, arguments = pickle.loads(call)
            value = function(**arguments)
            return {"value": exhausted(value) if isinstance(value, Generator) else value, **worker}
        except MbtfError as error:
            found = failure(error)
            if not there:
                found["hint"] = f"this machine does not see the working folder {folder}"
            return {**found, **worker}


def run_task_alone(call: bytes, expected: str, folder: str, gpu: int | None) -> dict[str, Any]:
    """:func:`run_task` in a child process; with the GPU of a number, if one is given."""
    if gpu is not None:
        # Precedes the import of CUDA.
        visible = os.environ.get("CUDA_VISIBLE_DEVICES")
        devices = visible.split(",") if visible else []
        os.environ["CUDA_VISIBLE_DEVICES"] = devices[gpu % len(devices)] if devices else str(gpu)
    try:
        return run_task(call, expected, folder)
    except Exception as error:
        return {"error": f"internal error: {type(error).__name__}: {reason(error)}"}


def exhausted(parts: Generator[None, None, Any]) -> Any:
    """Run all parts of a generator; returns its value."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            return end.value


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def worker_threads() -> int | None:
    """Threads that this worker may use; None outside of workers, and where nothing is stated."""
    text = os.environ.get(THREADS_VARIABLE, "")
    return int(text) if text.isdigit() and int(text) > 0 else None


def dask_setup(worker: Any) -> None:
    """Prepare a worker process; Dask calls it at its start.

    The signal of Ctrl-C reaches every process of a terminal; the command ends its workers itself. Workers of
    this machine, whose names are numbers, divide its GPUs.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    each = os.environ.get(GPUS_VARIABLE, "")
    if each.isdigit() and isinstance(worker.name, int):
        visible = os.environ.get("CUDA_VISIBLE_DEVICES")
        first = worker.name * int(each)
        numbers = visible.split(",") if visible else [str(n) for n in range(first + int(each))]
        os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(numbers[first : first + int(each)])

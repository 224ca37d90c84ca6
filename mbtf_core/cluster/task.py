"""A task of a cluster, and how a worker runs it."""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import version
from typing import Any

from mbtf_core.errors import LockedError, MbtfError, PartialError

# Environment variable with the threads of a worker.
THREADS_VARIABLE = "MBTF_WORKER_THREADS"
# GPUs of each worker of this machine.
GPUS_VARIABLE = "MBTF_WORKER_GPUS"
# Neither a renderer nor the working folder can be shared by the threads of a worker.
_ALONE = threading.Lock()


@dataclass(frozen=True)
class Task:
    """A function of ours with plain arguments. It may be run more than once, so it is idempotent: what it
    writes is absent or complete, and it does nothing where that is done.

    Attributes
    ----------
    name : for messages; unique in its run
    function : ``package.module:function``
    arguments : keyword arguments, plain data
    gpu : whether it takes a GPU of its worker
    """

    name: str
    function: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    gpu: bool = False


@dataclass(frozen=True)
class TaskResult:
    """How a task ended.

    Attributes
    ----------
    task : Task
    value : what the function returned; None where it failed
    error : why it failed, in one line; empty where it did not
    hint : what to do about it, where that is known
    fatal : the others fail for the same reason, such as files that a worker cannot read
    locked : another process works on the task's files
    worker : machine and process
    """

    task: Task
    value: Any = None
    error: str = ""
    hint: str = ""
    fatal: bool = False
    locked: bool = False
    worker: str = ""


def run_task(function: str, arguments: Mapping[str, Any], expected: str) -> dict[str, Any]:
    """Run a task; called on the worker.

    Parameters
    ----------
    expected : version of this package where the task comes from

    Returns
    -------
    dict
        The fields of :class:`TaskResult` except for the task.
    """
    worker = f"{socket.gethostname()}:{os.getpid()}"
    installed = version("mbtf")
    if installed != expected:
        error = f"the worker has version {installed} of mbtf, the command {expected}"
        hint = "install the same version on every machine"
        return {"error": error, "hint": hint, "fatal": True, "worker": worker}
    with _ALONE:
        try:
            module, _, name = function.partition(":")
            value = getattr(import_module(module), name)(**arguments)
        except MbtfError as error:
            text = f"{error.where}: {error.what}" if error.where else error.what
            fatal, locked = not isinstance(error, PartialError), isinstance(error, LockedError)
            found = {"error": text, "hint": error.hint, "fatal": fatal, "locked": locked}
            return {**found, "worker": worker}
        return {"value": value, "worker": worker}


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

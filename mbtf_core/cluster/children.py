"""Runs tasks on this machine, one after the other, each in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from multiprocessing.connection import Connection, wait
from typing import Any

from mbtf_core.cluster.task import Task, TaskResult, run_task
from mbtf_core.errors import reason
from mbtf_core.interruption import SIGNALS, at_end


def _end_with_parent() -> None:
    """End this process when its parent is killed, so that no lock of its outlives the command."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def _work(function: str, arguments: dict[str, Any], pipe: Connection) -> None:
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        pipe.send(run_task(function, arguments, version("mbtf")))
    except KeyboardInterrupt:
        pipe.send({"error": "interrupted"})
    except Exception as error:
        pipe.send({"error": f"internal error: {type(error).__name__}: {reason(error)}"})


def run_in_children(tasks: Iterable[Task]) -> Iterator[TaskResult]:
    """Run tasks in order; a crash ends the process of its task alone.

    Parameters
    ----------
    tasks : iterable of Task

    Yields
    ------
    TaskResult
    """
    context = multiprocessing.get_context("spawn")

    def kill() -> None:
        for child in multiprocessing.active_children():
            child.kill()

    at_end(kill)
    for task in tasks:
        mine, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(task.function, dict(task.arguments), theirs))
        # The process inherits this mask until it handles signals.
        signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        theirs.close()
        try:
            answer = mine.recv()
            process.join()
        except EOFError:
            process.join()
            answer = {"error": f"its process ended with code {process.exitcode}"}
        except KeyboardInterrupt:
            # What the task has finished is kept.
            process.terminate()
            process.join()
            raise
        yield TaskResult(task, **answer)

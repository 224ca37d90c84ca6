"""Runs tasks on this machine, one after the other, each in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import version
from multiprocessing.connection import Connection, wait
from typing import Any

from mbtf_core.cluster.task import Task, TaskResult, run_task
from mbtf_core.errors import reason
from mbtf_core.interruption import SIGNALS, at_end


def prepare_child() -> None:
    """Prepare a process that :func:`answer_of_child` has started: signals interrupt it, and it ends when its
    parent is killed, so that no lock of its outlives the command."""
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def answer_of_child(work: Callable[..., None], *arguments: Any) -> Any:
    """Call ``work(*arguments, pipe)`` in a process of its own and return what it sends.

    Parameters
    ----------
    work : callable
        Calls :func:`prepare_child`, unblocks ``SIGNALS``, and sends one answer.

    Raises
    ------
    ChildProcessError
        The process has ended without an answer; says how.
    KeyboardInterrupt
        The command is interrupted; the process is told, and has ended.
    """
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe(duplex=False)
    process = context.Process(target=work, args=(*arguments, theirs))
    # The process inherits this mask until it handles signals.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    theirs.close()
    try:
        answer = mine.recv()
        process.join()
    except EOFError:
        process.join()
        raise ChildProcessError(f"its process ended with code {process.exitcode}") from None
    except KeyboardInterrupt:
        # What it has finished is kept.
        process.terminate()
        process.join()
        raise
    return answer


def kill_children() -> None:
    """Kill all processes of :func:`answer_of_child`; for the end of a command without unwinding."""
    for child in multiprocessing.active_children():
        child.kill()


def _work(function: str, arguments: dict[str, Any], pipe: Connection) -> None:
    prepare_child()
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
    at_end(kill_children)
    for task in tasks:
        try:
            answer = answer_of_child(_work, task.function, dict(task.arguments))
        except ChildProcessError as error:
            answer = {"error": str(error)}
        yield TaskResult(task, **answer)

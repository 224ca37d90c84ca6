"""Runs functions and tasks in child processes, which may crash or hang, and reports how each ended.

A child is a fresh interpreter. It ends with its parent, so that no lock outlives a command.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Generator, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.connection import Connection, Pipe
from queue import SimpleQueue
from typing import Any

from mbtf_core.errors import InputError, reason
from mbtf_core.run.runner import Runner
from mbtf_core.run.signals import SIGNALS, at_end, handle_signals, raising
from mbtf_core.run.task import (
    THREADS_VARIABLE,
    Item,
    Result,
    TaskFunction,
    available_cores,
    packed,
    run_task_alone,
)

_CODE = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from mbtf_core.run.processes import _serve
_serve(int(sys.argv[2]))
"""
_children: set[subprocess.Popen[bytes]] = set()


@dataclass(frozen=True)
class ChildResult:
    """How a child ended.

    Attributes
    ----------
    answers : what the function returned or yielded, merged in order
    fault : why it did not finish, in one line; empty when it did
    seconds : wall time, start of the interpreter included
    """

    answers: dict[str, Any]
    fault: str
    seconds: float


def run_child(
    module: str,
    function: str,
    *arguments: Any,
    timeout: float | None = None,
    environment: Mapping[str, str] | None = None,
    trial: bool = True,
) -> ChildResult:
    """Call ``module.function(*arguments)`` in a fresh interpreter.

    Parameters
    ----------
    module, function : the function returns or yields mappings; the message of an exception becomes the fault
    *arguments : values that can be pickled
    timeout : seconds after which the child is killed
    environment : variables set for the child on top of this process's own
    trial : hide what it prints, and kill it on interruption. Otherwise it prints on standard error, and
        stores its work first

    Raises
    ------
    KeyboardInterrupt : the command is interrupted; the child has ended
    """
    path = json.dumps([entry or os.getcwd() for entry in sys.path])
    start = time.monotonic()
    answers: dict[str, Any] = {}
    fault: str | None = None
    with tempfile.TemporaryFile() as noise:
        mine, theirs = Pipe(duplex=False)
        # The child inherits this mask until it handles signals.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            child = subprocess.Popen(
                [sys.executable, "-c", _CODE, path, str(theirs.fileno())],
                stdin=subprocess.PIPE,
                stdout=noise if trial else 2,
                stderr=noise if trial else None,
                env={**os.environ, **(environment or {})},
                pass_fds=[theirs.fileno()],
            )
            _children.add(child)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()
        try:
            assert child.stdin is not None
            try:
                # The pipe stays open as long as this process lives.
                child.stdin.write(pickle.dumps((module, function, arguments)))
                child.stdin.flush()
                while fault is None:
                    left = None if timeout is None else max(0.0, timeout - (time.monotonic() - start))
                    if not mine.poll(left):
                        fault = f"no answer within {timeout:.0f} s"
                        child.kill()
                        break
                    answer, fault = mine.recv()
                    answers |= answer
            except (EOFError, BrokenPipeError):
                pass
            child.wait()
        except BaseException:
            # What a task has finished is kept.
            child.kill() if trial else child.terminate()
            child.wait()
            raise
        finally:
            _children.discard(child)
            mine.close()
        noise.seek(0)
        lines = [line.strip() for line in noise.read().decode(errors="replace").splitlines() if line.strip()]
    if fault is None:
        fault = f"the process was {_ending(child.returncode)}" + (f" ({lines[-1][:200]})" if lines else "")
    return ChildResult(answers, fault, time.monotonic() - start)


def _ending(code: int) -> str:
    signals = {int(s): s.name for s in signal.Signals}
    return f"ended by {signals.get(-code, f'signal {-code}')}" if code < 0 else f"ended with exit code {code}"


def end_children(number: signal.Signals = signal.SIGKILL) -> None:
    """Send a signal to all children of this process."""
    for child in tuple(_children):
        child.send_signal(number)


at_end(end_children)


def _serve(handle: int) -> None:
    """Work in the child: read the call from standard input, send the answers to a pipe."""
    handle_signals(silent=True)
    module, function, arguments = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    pipe = Connection(handle, readable=False)
    fault: str = ""
    try:
        with raising():
            found = getattr(import_module(module), function)(*arguments)
            for answer in found if isinstance(found, Iterator) else [found]:
                pipe.send((answer, None))
    except KeyboardInterrupt:
        fault = "interrupted"
    except Exception as error:
        fault = reason(str(getattr(error, "what", error)) or type(error).__name__, 1000)
    pipe.send(({}, fault))
    sys.stdout.flush()
    os._exit(0)


def _end_with_parent() -> None:
    os.read(0, 1)
    os._exit(1)


class Processes(Runner):
    """Runs items in processes of this machine, so many at a time, which divide the cores, each in one of its
    own: a crash ends its item alone."""

    here = False

    def __init__(self, workers: int = 1) -> None:
        self.workers = workers

    def takes_gpu(self, device: str) -> bool:
        """As of the base class; ``auto`` is a GPU where there is one."""
        return device != "cpu"

    def map(
        self,
        function: TaskFunction,
        items: Iterable[Item],
        *,
        independent: bool = False,
    ) -> Generator[Result]:
        """As of the base class."""
        free: SimpleQueue[int] = SimpleQueue()
        environment = {}
        for worker in range(self.workers):
            free.put(worker)
        if self.workers > 1:
            threads = str(max(1, available_cores() // self.workers))
            environment = {THREADS_VARIABLE: threads, "OMP_NUM_THREADS": threads}

        def run(item: Item) -> Result:
            worker = free.get()
            try:
                gpu = worker if item.gpu else None
                done = run_child(
                    run_task_alone.__module__,
                    run_task_alone.__name__,
                    *packed(function, item),
                    gpu,
                    environment=environment,
                    trial=False,
                )
            finally:
                free.put(worker)
            return Result(item.name, **(done.answers or {"error": done.fault}))

        with ThreadPoolExecutor(self.workers) as pool:
            futures = [pool.submit(run, item) for item in items]
            try:
                for future in as_completed(futures):
                    result = future.result()
                    if result.fatal and not independent:
                        raise InputError(result.error, where=result.name, hint=result.hint)
                    yield result
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                # The children store their work and exit.
                end_children(signal.SIGTERM)
                raise

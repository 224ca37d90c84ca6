"""Shards are written by a thread of their own, while the next ones are rendered."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from mbtf_core.locks import RENEW_SECONDS, Lock

Step = Callable[[], None]


class ShardWriter:
    """Writes what is handed to it, one thing after another, in a thread; a context manager.

    Leaving the context waits until everything is written, also after an interruption: what has been rendered
    is not lost. After a failure nothing more is written.

    Parameters
    ----------
    waiting : how many may wait beside the one that is being written; submitting more waits

    Attributes
    ----------
    busy : processor seconds spent writing
    waited : seconds that the other side waited for it
    """

    def __init__(self, waiting: int = 1) -> None:
        self.busy = 0.0
        self.waited = 0.0
        self._tasks: queue.Queue[tuple[Step, Step] | None] = queue.Queue(waiting)
        self._error: BaseException | None = None
        # A second interruption ends the process without waiting for it.
        self._thread = threading.Thread(target=self._work, name="shard writer", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        start = time.perf_counter()
        self._tasks.put(None)
        self._thread.join()
        self.waited += time.perf_counter() - start
        if kind is None:
            self.check()

    def submit(self, write: Step, after: Step) -> None:
        """Have `write()` called, then `after()` in any case.

        Raises
        ------
        whatever an earlier one raised; `after` is not called then
        """
        self.check()
        start = time.perf_counter()
        self._tasks.put((write, after))
        self.waited += time.perf_counter() - start

    def check(self) -> None:
        """Raise what writing has raised so far."""
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        while True:
            try:
                task = self._tasks.get(timeout=RENEW_SECONDS)
            except queue.Empty:
                Lock.renew()
                continue
            if task is None:
                return
            write, after = task
            start = time.thread_time()
            try:
                if self._error is None:
                    write()
            except BaseException as error:
                self._error = error
            finally:
                after()
                self.busy += time.thread_time() - start

"""Writes shards in a thread while the next ones are rendered."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

Step = Callable[[], None]


class ShardWriter:
    """Runs submitted tasks in order, in a thread; a context manager.

    Leaving the context waits until all tasks are done, also after an interruption, so that no rendered shard
    is lost. After a failure it skips the remaining tasks.

    Parameters
    ----------
    waiting : tasks in the queue at most; submitting more blocks

    Attributes
    ----------
    busy : processor seconds spent in tasks
    waited : seconds that the submitting thread waited
    """

    def __init__(self, waiting: int = 1) -> None:
        self.busy = 0.0
        self.waited = 0.0
        self._tasks: queue.Queue[tuple[Step, Step] | None] = queue.Queue(waiting)
        self._error: BaseException | None = None
        # As a daemon it does not delay the exit after a second interruption.
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
        """Call `write()` in the thread, then `after()` in any case.

        Raises
        ------
        the exception of an earlier task, if one failed; `after` is not called then
        """
        self.check()
        start = time.perf_counter()
        self._tasks.put((write, after))
        self.waited += time.perf_counter() - start

    def check(self) -> None:
        """Raise the exception of a failed task, if there is one."""
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        while True:
            task = self._tasks.get()
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

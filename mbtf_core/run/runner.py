"""What runs tasks: the runner of this process, and what the others have in common.

All runners give the same values. What a task has finished is kept, whichever process dies.
"""

from __future__ import annotations

import contextlib
import inspect
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from mbtf_core.errors import MbtfError
from mbtf_core.run.task import Item, Result, TaskFunction, failure


class Runner:
    """Maps a task over items; here, in this process, one after the other.

    Attributes
    ----------
    workers : number of workers, as last seen
    here : items run in this process
    """

    workers = 1
    here = True

    def takes_gpu(self, device: str) -> bool:
        """Whether an item for a device, ``cpu``, ``cuda`` or ``auto``, takes a GPU of its worker."""
        return device == "cuda"

    def map(
        self,
        function: TaskFunction,
        items: Iterable[Item],
        *,
        independent: bool = False,
    ) -> Generator[Result]:
        """Call a function for every item; yields each result as it comes.

        Parameters
        ----------
        function : of a module; see :mod:`mbtf_core.run.task`
        items : read as workers become free
        independent : a failure that concerns files or options says nothing about the other items

        Raises
        ------
        InputError : an item failed for a reason that concerns all of them; the others are canceled
        PartialError : the workers cannot be reached any more
        """
        waiting = iter(items)
        while True:
            progress = False
            locked: list[tuple[Item, Result]] = []
            with contextlib.closing(_overlapped(function, waiting)) as ended:
                for item, value in ended:
                    if not isinstance(value, MbtfError):
                        result = Result(item.name, value)
                    elif (found := failure(value))["fatal"] and not independent:
                        raise value
                    else:
                        result = Result(item.name, **found)
                    if result.locked:
                        locked.append((item, result))
                        continue
                    progress = True
                    yield result
            if not progress:
                break
            # Another process may have finished some by now.
            waiting = iter([item for item, _ in locked])
        for _, result in locked:
            yield result


def _overlapped(function: TaskFunction, items: Iterator[Item]) -> Generator[tuple[Item, Any]]:
    """Items and the values or errors of a function, in the order in which they end. The first and last part
    of a generator run in threads, one item ahead and one behind."""
    ahead, behind = ThreadPoolExecutor(1, "ahead"), ThreadPoolExecutor(1, "behind")
    opened: list[Generator[None, None, Any]] = []
    begun: deque[tuple[Item, Any, Future[Any]]] = deque()
    ending: deque[tuple[Item, Any, Future[Any]]] = deque()
    try:
        while True:
            while len(begun) < 2 and (item := next(items, None)) is not None:
                if not inspect.isgeneratorfunction(function):
                    yield item, _tried(function, **item.arguments)
                    continue
                parts = function(**item.arguments)
                opened.append(parts)
                begun.append((item, parts, ahead.submit(_part, parts)))
            if not begun and not ending:
                return
            # One is behind at most: more would take memory.
            while ending and (not begun or len(ending) > 1 or ending[0][2].done()):
                item, parts, last = ending.popleft()
                _, value = last.result()
                opened.remove(parts)
                yield item, value
            if not begun:
                continue
            item, parts, first = begun.popleft()
            done, value = first.result()
            if not done:
                done, value = _part(parts)
            if done:
                opened.remove(parts)
                yield item, value
            else:
                ending.append((item, parts, behind.submit(_part, parts)))
    finally:
        # The threads finish what they do.
        ahead.shutdown(cancel_futures=True)
        behind.shutdown()
        for parts in opened:
            parts.close()


def _tried(function: Callable[..., Any], **arguments: Any) -> Any:
    """Value of a function, or its error."""
    try:
        return function(**arguments)
    except MbtfError as error:
        return error


def _part(parts: Generator[None, None, Any]) -> tuple[bool, Any]:
    """Run the next part of a generator: whether it has ended, and its value or error then."""
    try:
        next(parts)
    except StopIteration as end:
        return True, end.value
    except MbtfError as error:
        return True, error
    return False, None

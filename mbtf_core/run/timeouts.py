"""Time limits for calls of libraries that may never return."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
_STEP_SECONDS = 1.0


class NoAnswer(TimeoutError):
    """A call has not returned in time."""


def call_within(seconds: float, function: Callable[[], T]) -> T:
    """Result of a call, or its error, which runs in a thread of its own; :class:`NoAnswer` where it has not
    returned in time.

    A call that exceeds its time goes on in its thread, which does not delay the exit. While this process is
    stopped, as by Ctrl-Z, the time does not count.
    """
    results: list[T] = []
    errors: list[BaseException] = []
    ended = threading.Event()

    def call() -> None:
        try:
            results.append(function())
        except BaseException as error:
            errors.append(error)
        finally:
            ended.set()

    threading.Thread(target=call, name="call", daemon=True).start()
    left = seconds
    while not ended.wait(min(left, _STEP_SECONDS)):
        left -= _STEP_SECONDS
        if left <= 0:
            raise NoAnswer(f"no answer within {seconds:.0f} s")
    if errors:
        raise errors[0]
    return results[0]

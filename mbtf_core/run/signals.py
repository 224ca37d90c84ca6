"""Signals that end a program: SIGINT of Ctrl-C, and SIGTERM, which batch systems send.

A signal raises KeyboardInterrupt, so that finished work is stored and locks are released. Libraries may
delay, swallow or convert that exception; a thread therefore ends the process after a grace period. A second
signal, or one during an import, ends it at once: files are absent or complete at every instant.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from types import FrameType
from typing import NoReturn

from mbtf_core.errors import EXIT_INTERRUPTED

SIGNALS = (signal.SIGINT, signal.SIGTERM)
# Seconds from the signal to a note on standard error, and from there to the end of the process.
_NOTE_SECONDS, _GRACE_SECONDS = 1.5, 10.0
# A terminal and a wrapper such as `uv run` may both send the signal of one Ctrl-C.
_ECHO_SECONDS = 0.5


class _State:
    """State of this process."""

    # It runs one of our programs, so that a signal may end it; not so in notebooks and tests.
    program = False
    # Messages are its parent's.
    silent = False
    # A signal raises KeyboardInterrupt, which :func:`mbtf_core.app.console.run` handles.
    raising = False
    # Time of the first signal.
    received: float | None = None
    # The event that the first signal sets in place of an exception.
    stop: threading.Event | None = None
    # What an interruption leaves, for the message.
    kept = ""
    # Called before the process ends without unwinding.
    cleanups: list[Callable[[], None]] = []  # noqa: RUF012
    # Exit code of the program's command once it has ended.
    code: int | None = None


def handle_signals(silent: bool = False) -> None:
    """Prepare a new process of a program for signals; precedes all slow imports. The parent of a
    `silent` one prints its messages."""
    _State.program, _State.silent = True, silent
    for number in SIGNALS:
        # `nohup` and shells without job control have it ignored.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    # Called last: after threads are joined and all other exit functions have run.
    atexit.register(_skip_unloading)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    # Native code delays Python's handlers, but not these bytes.
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reader,), name="signals", daemon=True).start()


def _skip_unloading() -> None:
    """End the process where a command has ended. The interpreter would unload all modules, PyTorch's for a
    second, and restore the default actions of signals meanwhile."""
    if _State.code is not None:
        _flush()
        os._exit(_State.code)


def _flush() -> None:
    """Flush the standard streams; the reader of a closed pipe has seen enough."""
    # A stream that was closed before the start is None.
    for stream in filter(None, (sys.stdout, sys.stderr)):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()


def _handle(number: int, frame: FrameType | None) -> None:
    """The one handler of both signals."""
    now, before = time.monotonic(), _State.received
    if before is not None and now - before < _ECHO_SECONDS:
        return
    _State.received = now if before is None else before
    if _State.stop is not None and not _State.stop.is_set():
        _State.stop.set()
        return
    if _State.program and (before is not None or not _State.raising or _importing(frame)):
        _end_process()
    raise KeyboardInterrupt


def _importing(frame: FrameType | None) -> bool:
    """Is a module being imported? Native modules turn exceptions into crashes or into failed imports."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _watch(reader: int) -> None:
    while os.read(reader, 1)[0] not in SIGNALS:
        pass
    time.sleep(_NOTE_SECONDS)
    _say("stopping after the current step; a second signal stops at once\n")
    time.sleep(_GRACE_SECONDS)
    _end_process()


def _say(text: str) -> None:
    if not _State.silent:
        with contextlib.suppress(OSError):
            os.write(2, text.encode())


def _end_process() -> NoReturn:
    for cleanup in _State.cleanups:
        cleanup()
    # A progress bar hides the cursor.
    start = "\x1b[?25h\n" if os.isatty(2) else ""
    _say(f"{start}error: {message()}\n")
    os._exit(EXIT_INTERRUPTED)


def interrupted() -> bool:
    """Whether a signal was received."""
    return _State.received is not None


def message() -> str:
    """An interruption in words, and how to continue."""
    if _State.kept:
        return f"interrupted; {_State.kept}\n  the same command resumes"
    return "interrupted\n  run the same command again"


def keep_on_interruption(kept: str) -> None:
    """State what an interruption leaves from now on, for a command that resumes."""
    _State.kept = kept


def at_end(cleanup: Callable[[], None]) -> None:
    """Call a function before a signal ends the process without unwinding."""
    _State.cleanups.append(cleanup)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


@contextlib.contextmanager
def _handling(numbers: Iterable[signal.Signals]) -> Iterator[None]:
    """Handle these signals here in a block."""
    before = {number: signal.getsignal(number) for number in numbers}
    for number in before:
        signal.signal(number, _handle)
    try:
        yield
    finally:
        for number, handler in before.items():
            # None stands for a native handler, which a renderer leaves and which is no longer valid.
            signal.signal(number, signal.default_int_handler if handler is None else handler)


@contextlib.contextmanager
def raising() -> Iterator[None]:
    """Signals raise KeyboardInterrupt in this block; it runs a command."""
    numbers: list[signal.Signals] = []
    if not _State.program:
        _State.received, _State.kept = None, ""
        usual = (signal.SIG_DFL, signal.default_int_handler, None)
        numbers = [n for n in SIGNALS if _in_main_thread() and signal.getsignal(n) in usual]
    _State.raising = True
    try:
        with _handling(numbers):
            yield
    finally:
        _State.raising = False


@contextlib.contextmanager
def stop_on_interruption() -> Iterator[threading.Event]:
    """An event that the first signal sets, instead of an exception, so that work ends after its current step;
    the second signal interrupts as usual. The block raises KeyboardInterrupt itself once it has stored its
    state."""
    stop = threading.Event()
    if not _in_main_thread():
        yield stop
        return
    if not _State.program:
        _State.received = None
    _State.stop = stop
    try:
        with _handling(number for number in SIGNALS if callable(signal.getsignal(number))):
            yield stop
    finally:
        _State.stop = None


@contextlib.contextmanager
def served_until_interruption() -> Iterator[None]:
    """After a block, which announces a service, wait for the signal that ends it. A signal during the block
    counts too: it is the regular end, with the exit code 0."""
    with stop_on_interruption() as stop:
        yield
        while not stop.wait(0.5):
            pass
    _State.received = None


def finish(code: int) -> int:
    """Last act of a program: the exit code of its command. After an interruption it ends the process, whose
    threads may still work; else exit functions run, and a signal can no longer change the code."""
    if _State.received is not None:
        _flush()
        os._exit(code)
    _State.code = code
    for number in SIGNALS:
        signal.signal(number, lambda *_: os._exit(code))
    return code

"""Locks per shard: a file beside the shard names its writer, so that several writers share one folder.

The lock is the kernel's advisory lock on that file (the library filelock), which ends with its process; on
file systems without such locks, the file itself.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from mbtf_core.errors import PartialError, unwritable

# Timeout of locks that are used briefly; of one attempt, since an owner may just have removed its file; and
# the interval of attempts.
_PATIENCE_SECONDS, _ATTEMPT_SECONDS, _POLL_SECONDS = 60.0, 0.05, 0.01


def _age(seconds: float) -> str:
    for size, unit in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"


class Lock:
    """An acquired lock; any thread may :meth:`release` it."""

    def __init__(self, lock: BaseFileLock) -> None:
        self._lock = lock

    def release(self) -> None:
        """Remove the file and release the lock; repeated calls do nothing."""
        if self._lock.is_locked:
            # A file that cannot be removed is harmless without the system's lock.
            with contextlib.suppress(OSError):
                os.unlink(self._lock.lock_file)
            with contextlib.suppress(OSError):
                self._lock.release()


def lock_file_of(path: Path) -> Path:
    """The lock that belongs to a shard, or to another file of its folder."""
    return path.with_name(f".{path.stem}.lock")


def lock_owner(path: Path) -> str | None:
    """Current or last owner of the lock of `path`, such as ``process 7 on oak, for 2 h``; None if unknown."""
    try:
        data = json.loads(lock_file_of(path).read_bytes()[:4096])
        age = _age(time.time() - float(data["since"]))
        return f"process {int(data['process'])} on {data['host']}, for {age}"
    except (OSError, ValueError, KeyError, TypeError):
        return None


def take_lock(path: Path) -> Lock | None:
    """Acquire the lock of the shard `path`; None when another writer owns it.

    Raises
    ------
    PartialError : the folder cannot be written
    """
    file = lock_file_of(path)
    lock = FileLock(file, timeout=_ATTEMPT_SECONDS, poll_interval=_POLL_SECONDS, thread_local=False)
    try:
        lock.acquire()
        # Without the system's locks the library needs the content of the file itself.
        if not isinstance(lock, SoftFileLock):
            owner = {"host": socket.gethostname(), "process": os.getpid(), "since": time.time()}
            file.write_text(json.dumps(owner))
    except Timeout:
        return None
    except OSError as error:
        Lock(lock).release()
        raise unwritable(file, error) from None
    return Lock(lock)


@contextlib.contextmanager
def shard_lock(path: Path) -> Iterator[bool]:
    """Acquire the lock of the shard `path` for a block; yields False when another writer owns it."""
    lock = take_lock(path)
    try:
        yield lock is not None
    finally:
        if lock is not None:
            lock.release()


@contextlib.contextmanager
def brief_lock(path: Path) -> Iterator[None]:
    """Acquire a lock that is only used briefly, such as the manifest's, and wait for it if needed.

    Raises
    ------
    PartialError : another process does not release it
    """
    give_up = time.monotonic() + _PATIENCE_SECONDS
    while (lock := take_lock(path)) is None:
        if time.monotonic() > give_up:
            raise PartialError(
                f"is being written by another process ({lock_owner(path)})",
                where=path,
                hint="wait for it, then run the same command again",
            )
        time.sleep(_POLL_SECONDS)
    try:
        yield
    finally:
        lock.release()

"""Locks per shard: a file beside the shard names its writer, so that several writers share one folder.

The lock is the kernel's advisory lock on that file (the library filelock), which ends with its process,
whatever the date of the file. On file systems without such locks it is the file itself, whose date its owner
renews. There, a lock is abandoned if its date is minutes away from the time of the file system, past or
future: clocks of machines may differ, but all dates are those of the file system.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from mbtf_core.errors import PartialError, unwritable

# Timeout of locks that are used briefly; of one attempt, since an owner may just have removed its file; and
# the interval of attempts.
_PATIENCE_SECONDS, _ATTEMPT_SECONDS, _POLL_SECONDS = 60.0, 0.05, 0.01
# Of locks that are files: interval at which their date is renewed; distance of the date of abandoned ones.
_RENEWAL_SECONDS, ABANDONED_SECONDS = 60.0, 300.0


def _age(seconds: float) -> str:
    for size, unit in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"


class Lock:
    """An acquired lock, a file, with the lock of the system; None where the lock is the file itself. Any
    thread may :meth:`release` it."""

    def __init__(self, file: Path, lock: BaseFileLock | None) -> None:
        self._file, self._lock = file, lock
        self._released = threading.Event()
        if lock is None:
            threading.Thread(target=self._renew, name="lock", daemon=True).start()

    def _renew(self) -> None:
        while not self._released.wait(_RENEWAL_SECONDS):
            with contextlib.suppress(OSError):
                os.utime(self._file)

    def release(self) -> None:
        """Remove the file and release the lock; repeated calls do nothing."""
        if self._released.is_set():
            return
        self._released.set()
        # A file that cannot be removed is harmless without the system's lock.
        with contextlib.suppress(OSError):
            os.unlink(self._file)
        if self._lock is not None:
            with contextlib.suppress(OSError):
                self._lock.release()


def lock_file_of(path: Path) -> Path:
    """The lock that belongs to a shard, or to another file of its folder."""
    return path.with_name(f".{path.stem}.lock")


def _seconds_since(file: Path) -> float:
    """Time since the date of a file, by the clock of its file system."""
    try:
        with tempfile.TemporaryFile(dir=file.parent) as fresh:
            # Its date is that of its last change.
            fresh.write(b"0")
            fresh.flush()
            now = os.fstat(fresh.fileno()).st_mtime
    except OSError:  # of a folder that is only read
        now = time.time()
    return now - file.stat().st_mtime


def _remove_abandoned(file: Path) -> bool:
    """Remove a lock that is a file, if its owner is gone; whether it was so."""
    try:
        before = file.stat()
        if abs(_seconds_since(file)) < ABANDONED_SECONDS:
            return False
        aside = file.with_name(f"{file.name}.{socket.gethostname()}-{os.getpid()}-{threading.get_ident()}")
        os.rename(file, aside)
        if aside.stat().st_mtime != before.st_mtime:
            # Another process was faster, and owns the lock.
            os.link(aside, file)
        aside.unlink()
    except OSError:
        return False
    return True


def lock_owner(path: Path) -> str | None:
    """Current or last owner of the lock of `path`, such as ``process 7 on oak, for 2 h``; None if unknown."""
    try:
        file = lock_file_of(path)
        data = json.loads(file.read_bytes()[:4096])
        # Its date is that of the acquisition; the clock of its owner may be wrong.
        age = _age(_seconds_since(file))
        return f"process {int(data['process'])} on {data['host']}, for {age}"
    except (OSError, ValueError, KeyError, TypeError):
        return None


def take_lock(path: Path) -> Lock | None:
    """Acquire the lock of the shard `path`; None when another writer owns it, a PartialError where the folder
    cannot be written."""
    file = lock_file_of(path)
    owner = json.dumps({"host": socket.gethostname(), "process": os.getpid(), "since": time.time()})
    if not _has_locks(file.parent):
        free = _created(file, owner) or (_remove_abandoned(file) and _created(file, owner))
        return Lock(file, None) if free else None
    lock = FileLock(file, timeout=_ATTEMPT_SECONDS, poll_interval=_POLL_SECONDS, thread_local=False)
    try:
        lock.acquire()
        file.write_text(owner)
    except Timeout:
        return None
    except OSError as error:
        if lock.is_locked:
            Lock(file, lock).release()
        raise unwritable(file, error) from None
    return Lock(file, lock)


def _created(file: Path, owner: str) -> bool:
    """Create a lock that is a file; False where there is one."""
    try:
        with file.open("x") as stream:
            stream.write(owner)
    except FileExistsError:
        return False
    except OSError as error:
        raise unwritable(file, error) from None
    return True


def _has_locks(folder: Path) -> bool:
    """Whether the file system of a folder has the system's locks."""
    try:
        import fcntl

        handle = os.open(folder, os.O_RDONLY)
    except (ImportError, OSError):  # of another system; or what follows says why
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.ENOSYS, errno.ENOTSUP)
    finally:
        os.close(handle)
    return True


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
    """Acquire a lock that is only used briefly, such as the manifest's, and wait for it if needed; a
    PartialError where another process does not release it."""
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

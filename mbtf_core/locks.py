"""Locks per shard: a file beside the shard names its writer, so that several writers share one folder.

The lock is the kernel's advisory lock on that file, which ends with its process. Machines that share a folder
but no advisory locks read the file: it names the writer's machine, and the writer renews its age.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from mbtf_core.atomic import unwritable
from mbtf_core.errors import PartialError
from mbtf_core.run import signals

# Age after which the lock of another machine counts as abandoned, and the interval of renewal.
STALE_SECONDS = 300.0
RENEW_SECONDS = 60.0
# Errors of file systems without advisory locks.
_NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)
# Polling interval and timeout of locks that are used briefly.
_POLL_SECONDS = 0.02
_PATIENCE_SECONDS = 60.0


@dataclass(frozen=True)
class Owner:
    """Owner of a lock: machine, process, and start (seconds since 1970)."""

    host: str
    process: int
    since: float

    def __str__(self) -> str:
        return f"process {self.process} on {self.host}, for {_age(time.time() - self.since)}"


def _age(seconds: float) -> str:
    for size, unit in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"


class Lock:
    """An acquired lock; any thread may :meth:`release` it."""

    _held: ClassVar[set[Lock]] = set()
    _guard: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, path: Path, handle: int) -> None:
        self.path = path
        self._handle = handle
        with Lock._guard:
            Lock._held.add(self)

    def release(self) -> None:
        """Remove the file and release the lock; repeated calls do nothing."""
        with Lock._guard:
            if self not in Lock._held:
                return
            Lock._held.discard(self)
            try:
                # A file that cannot be removed is harmless without the system's lock.
                with contextlib.suppress(OSError):
                    self.path.unlink()
            finally:
                os.close(self._handle)

    @classmethod
    def renew(cls) -> None:
        """Renew the age of all locks of this process, for other machines."""
        with cls._guard:
            for lock in cls._held:
                with contextlib.suppress(OSError):
                    os.utime(lock._handle)

    @classmethod
    def abandon(cls) -> None:
        """Remove the files of all locks of this process, which is about to end."""
        for lock in tuple(cls._held):
            with contextlib.suppress(OSError):
                lock.path.unlink()


signals.at_end(Lock.abandon)


@contextlib.contextmanager
def keep_renewing() -> Iterator[None]:
    """Renew the locks of this process while a block runs."""
    done = threading.Event()

    def renew() -> None:
        while not done.wait(RENEW_SECONDS):
            Lock.renew()

    threading.Thread(target=renew, name="lock renewal", daemon=True).start()
    try:
        yield
    finally:
        done.set()


def lock_file_of(path: Path) -> Path:
    """The lock that belongs to a shard, or to another file of its folder."""
    return path.with_name(f".{path.stem}.lock")


def _parsed(content: bytes) -> Owner | None:
    try:
        data = json.loads(content)
        return Owner(str(data["host"]), int(data["process"]), float(data["since"]))
    except (ValueError, KeyError, TypeError):
        return None


def lock_owner(path: Path) -> Owner | None:
    """Current or last owner of the lock of `path` according to its file; None if unknown."""
    try:
        return _parsed(lock_file_of(path).read_bytes()[:4096])
    except OSError:
        return None


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _held_elsewhere(handle: int, real: bool, stale: float) -> bool:
    """Does the file name an owner that the system's lock does not show?

    That is a recent one on another machine or, without locks, another living process.
    """
    owner = _parsed(os.pread(handle, 4096, 0))
    if owner is None:
        return False
    if owner.host != socket.gethostname():
        return time.time() - os.fstat(handle).st_mtime < stale
    return not real and owner.process != os.getpid() and owner.process > 0 and _alive(owner.process)


def take_lock(path: Path, stale: float = STALE_SECONDS) -> Lock | None:
    """Acquire the lock of the shard `path`; None when another writer owns it.

    Parameters
    ----------
    path : Path
    stale : float
        Age in seconds above which another machine's lock counts as abandoned.

    Raises
    ------
    PartialError : the folder cannot be written
    """
    file = lock_file_of(path)
    while True:
        with contextlib.ExitStack() as stack:
            try:
                handle = os.open(file, os.O_CREAT | os.O_RDWR, 0o666)
                stack.callback(os.close, handle)
                supported = _flock(handle)
                if supported is None:
                    return None
                try:
                    # The former owner removes the file before releasing it, so the locked file may be gone.
                    if not os.path.samestat(os.fstat(handle), os.stat(file)):
                        continue
                except FileNotFoundError:
                    continue
                if _held_elsewhere(handle, supported, stale):
                    return None
                owner = {"host": socket.gethostname(), "process": os.getpid(), "since": time.time()}
                try:
                    os.ftruncate(handle, 0)
                    os.pwrite(handle, json.dumps(owner).encode(), 0)
                except OSError:
                    # The disk is full.
                    file.unlink(missing_ok=True)
                    raise
            except OSError as error:
                raise unwritable(file, error) from None
            stack.pop_all()
            return Lock(file, handle)


def _flock(handle: int) -> bool | None:
    """Lock a file: True; None if another process owns it; False if the file system has no such locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        return False
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
    """Acquire a lock that is only used briefly, such as the manifest's, and wait for it if needed.

    Raises
    ------
    PartialError : another process does not release it
    """
    give_up = time.monotonic() + _PATIENCE_SECONDS
    while (lock := take_lock(path, _PATIENCE_SECONDS)) is None:
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

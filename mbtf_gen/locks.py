"""Locks per shard: a file beside the shard that names its writer, so that several writers share one folder.

The lock itself is the kernel's advisory lock on that file: it ends with its process, however that ends, and
nobody has to guess whether a writer still lives. Machines that share a folder without sharing such locks go
by what the file says: its writer's machine and its age.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

# Seconds after which the lock of another machine counts as abandoned; a shard takes seconds to minutes.
STALE_SECONDS = 1800.0
# What a file system without advisory locks answers.
_NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)


def _lock_file(lock: Path) -> int | None:
    """Descriptor of the locked file; None where another process holds it."""
    while True:
        handle = os.open(lock, os.O_CREAT | os.O_RDWR, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            return None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                os.close(handle)
                raise
        # Its former holder removes the file before letting go: what is locked may be gone from the folder.
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), os.stat(lock)):
                return handle
        os.close(handle)


def _held_elsewhere(handle: int) -> bool:
    """Whether another machine wrote the file's content, not long ago."""
    try:
        host = str(json.loads(os.pread(handle, 4096, 0))["host"])
    except (ValueError, KeyError, TypeError):
        return False
    return host != socket.gethostname() and time.time() - os.fstat(handle).st_mtime < STALE_SECONDS


@contextlib.contextmanager
def shard_lock(path: Path) -> Iterator[bool]:
    """Hold the lock of the shard `path`; yields False when another writer holds it."""
    lock = path.with_name(f".{path.stem}.lock")
    handle = _lock_file(lock)
    if handle is None:
        yield False
        return
    try:
        if _held_elsewhere(handle):
            yield False
            return
        owner = {"host": socket.gethostname(), "process": os.getpid(), "since": time.time()}
        os.ftruncate(handle, 0)
        os.pwrite(handle, json.dumps(owner).encode(), 0)
        try:
            yield True
        finally:
            lock.unlink(missing_ok=True)
    finally:
        os.close(handle)

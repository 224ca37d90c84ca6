"""Locks per shard: a file beside the shard that names its writer, so that several writers share one folder.

A lock is taken over when its writer is gone: on the same machine when there is no such process, on another
when the lock is older than any shard takes.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

# Seconds after which the lock of another machine counts as abandoned; a shard takes seconds to minutes.
STALE_SECONDS = 1800.0
# Locks of this process. Process numbers come again, after a restart of a container in particular.
_held: set[Path] = set()


def _owner_is_gone(lock: Path) -> bool:
    try:
        age = time.time() - lock.stat().st_mtime
        owner = json.loads(lock.read_text())
        host, process = str(owner["host"]), int(owner["process"])
    except FileNotFoundError:
        return True
    except (OSError, ValueError, KeyError, TypeError):
        # Half-written by a process that died; a live writer needs milliseconds.
        return age > 5.0
    if host == socket.gethostname():
        if process == os.getpid():
            return lock.resolve() not in _held
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return True
        except PermissionError:
            pass
        return False
    return age > STALE_SECONDS


@contextlib.contextmanager
def shard_lock(path: Path) -> Iterator[bool]:
    """Hold the lock of the shard `path`; yields False when another writer holds it."""
    lock = path.with_name(f".{path.stem}.lock")
    if lock.exists() and _owner_is_gone(lock):
        lock.unlink(missing_ok=True)
    try:
        handle = os.open(lock, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
    except FileExistsError:
        yield False
        return
    _held.add(lock.resolve())
    try:
        with os.fdopen(handle, "w") as stream:
            owner = {"host": socket.gethostname(), "process": os.getpid(), "since": time.time()}
            json.dump(owner, stream)
        yield True
    finally:
        _held.discard(lock.resolve())
        lock.unlink(missing_ok=True)

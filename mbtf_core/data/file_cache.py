"""The cache of downloaded files: whole files by their digest, which all processes of a user share."""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import file_sha256, write_chunks
from mbtf_core.files.folders import make_folder

# Bytes of a cache by default.
CACHE_BYTES = 20e9
# Files that were fetched last and that are never removed: their readers are about to open them.
_KEPT = 4
# Seconds after which the unfinished file of another process counts as abandoned.
_ABANDONED_SECONDS = 86400.0


class FileCache:
    """Whole files by their SHA-256 in a folder, which all processes of a user share: at most `limit` bytes of
    them, but at least the few that were fetched last.

    A file is complete once it has its name. One that has changed since is read again. The files that were
    used least recently make room for new ones. A mapped file stays readable after it has been removed.
    """

    def __init__(self, folder: Path, limit: float = CACHE_BYTES) -> None:
        self.folder = folder
        self.limit = limit
        # A thread may read the next batch while another one reads a shard.
        self._lock = threading.Lock()
        self._recent: deque[str] = deque(maxlen=_KEPT)
        # Files whose digest this process has checked, as they were then.
        self._checked: dict[str, tuple[int, ...]] = {}

    def fetch(self, sha256: str, suffix: str, size: int, read: Callable[[], bytes]) -> Path:
        """The file of this size with a digest; ``read()`` returns its content if it is missing or damaged. An
        InputError where that has another digest, a PartialError where the disk is full, or an error of
        `read`."""
        path = self.folder / f"{sha256}{suffix}"
        with self._lock:
            if path.name in self._recent:
                self._recent.remove(path.name)
            self._recent.append(path.name)
            with contextlib.suppress(OSError):
                if path.stat().st_size == size and self._is_intact(path, sha256):
                    # Its age is the time since it was used.
                    os.utime(path)
                    self._checked[path.name] = _state(path)
                    return path
            make_folder(self.folder)
            self._make_room(size)
            content = read()
            if hashlib.sha256(content).hexdigest() != sha256:
                raise InputError("has changed since it was written (SHA-256 differs)")
            write_chunks(path, [content])
            self._checked[path.name] = _state(path)
            return path

    def _is_intact(self, path: Path, sha256: str) -> bool:
        """Whether a cached file has its digest; it is read once, and again after each change."""
        return self._checked.get(path.name) == _state(path) or file_sha256(path) == sha256

    def _make_room(self, size: int) -> None:
        """Remove files until `size` bytes more fit."""
        found: list[tuple[float, int, str]] = []
        with contextlib.suppress(OSError), os.scandir(self.folder) as entries:
            for entry in entries:
                with contextlib.suppress(OSError):
                    stat = entry.stat()
                    found.append((stat.st_mtime, stat.st_size, entry.name))
        total = size + sum(bytes_ for _, bytes_, _ in found)
        now = time.time()
        for used, bytes_, name in sorted(found):
            if name.startswith("."):
                removed = now - used > _ABANDONED_SECONDS
            else:
                removed = total > self.limit and name not in self._recent
            if not removed:
                continue
            with contextlib.suppress(OSError):
                os.unlink(self.folder / name)
                total -= bytes_


def _state(path: Path) -> tuple[int, ...]:
    """Changes when a file is replaced or written to."""
    stat = path.stat()
    return stat.st_ino, stat.st_size, stat.st_mtime_ns

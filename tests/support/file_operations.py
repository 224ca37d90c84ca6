"""Every file operation below a folder, counted, so that one of them can fail or end the process.

An operation is known by what it does, to which file, and for which time: ``("write", "train-00001.npz", 2)``.
That is the same in every run, whichever thread comes first; names of unfinished files stand without the
process that writes them.
"""

from __future__ import annotations

import builtins
import fcntl
import io
import os
import re
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

Operation = tuple[str, str, int]
Reaction = Callable[[Operation], None]

# Calls whose first argument is a path, and those whose first argument is a descriptor.
_BY_PATH = ("open", "replace", "link", "unlink", "mkdir", "listdir", "scandir", "stat")
_BY_HANDLE = ("fsync", "ftruncate", "pwrite", "pread")


class _Raw(io.FileIO):
    """A file whose reads and writes are counted."""

    watch: FileOperations

    def write(self, data: Any) -> int:
        # What goes wrong goes wrong in the middle.
        view = memoryview(data).cast("B")
        half = super().write(view[: len(view) // 2])
        self.watch.happens("write", self.name)
        return half + super().write(view[half:])

    def readinto(self, buffer: Any) -> int:
        self.watch.happens("read", self.name)
        return super().readinto(buffer)

    def readall(self) -> bytes:
        self.watch.happens("read", self.name)
        return super().readall()


class FileOperations:
    """Watches the operations of this process below `folder` while it is entered.

    Parameters
    ----------
    react : called before each of them; may raise OSError, or never return

    Attributes
    ----------
    seen : the operations so far
    """

    def __init__(self, folder: Path, react: Reaction = lambda operation: None) -> None:
        self.folder = str(folder)
        self.react = react
        self.seen: list[Operation] = []
        self._counts: Counter[tuple[str, str]] = Counter()
        self._guard = threading.RLock()
        self._names: dict[int, str] = {}
        self._patches: list[Any] = []

    def happens(self, kind: str, path: Any) -> None:
        """Count an operation, if it is one on a file of the folder."""
        try:
            name = os.fspath(path)
        except TypeError:
            return
        if isinstance(name, bytes) or not f"{name}/".startswith(f"{self.folder}/"):
            return
        short = re.sub(r"\.[0-9a-f]{8}-\d+\.tmp$", ".tmp", name[len(self.folder) + 1 :])
        with self._guard:
            self._counts[kind, short] += 1
            operation = kind, short, self._counts[kind, short]
            self.seen.append(operation)
        self.react(operation)

    def __enter__(self) -> FileOperations:
        for name in _BY_PATH:
            self._replace(os, name, self._by_path(name, getattr(os, name)))
        for name in _BY_HANDLE:
            self._replace(os, name, self._by_handle(name, getattr(os, name)))
        self._replace(fcntl, "flock", self._by_handle("flock", fcntl.flock))
        opened = self._opened(io.open)
        self._replace(io, "open", opened)
        self._replace(builtins, "open", opened)
        return self

    def __exit__(self, *_: object) -> None:
        while self._patches:
            self._patches.pop().stop()

    def _replace(self, holder: Any, name: str, function: Any) -> None:
        changed = patch.object(holder, name, function)
        changed.start()
        self._patches.append(changed)

    def _by_path(self, kind: str, real: Any) -> Any:
        def call(path: Any = ".", *arguments: Any, **options: Any) -> Any:
            self.happens(kind, path)
            result = real(path, *arguments, **options)
            if kind == "open" and not isinstance(path, bytes):
                self._names[result] = os.fspath(path)
            return result

        return call

    def _by_handle(self, kind: str, real: Any) -> Any:
        def call(handle: Any, *arguments: Any) -> Any:
            self.happens(kind, self._names.get(handle))
            return real(handle, *arguments)

        return call

    def _opened(self, real: Any) -> Any:
        def call(file: Any, mode: str = "r", buffering: int = -1, *arguments: Any, **options: Any) -> Any:
            if isinstance(file, int) or not f"{os.fspath(file)}/".startswith(f"{self.folder}/"):
                return real(file, mode, buffering, *arguments, **options)
            self.happens("open", file)
            raw = _Raw(file, mode.replace("b", "").replace("t", ""))
            raw.watch = self
            self._names[raw.fileno()] = os.fspath(file)
            if "+" in mode:
                stream: Any = io.BufferedRandom(raw)
            else:
                stream = io.BufferedReader(raw) if "r" in mode else io.BufferedWriter(raw)
            if "b" in mode:
                return stream
            return io.TextIOWrapper(stream, *arguments, **options)

        return call

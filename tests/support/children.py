"""Functions for child processes, which start sooner where they import little."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any

from mbtf_core.errors import EngineError


def abort() -> Iterator[dict[str, Any]]:
    """Answers once and aborts, as LLVM does."""
    yield {"step": 1}
    os.write(2, b"LLVM ERROR: Cannot select\n")
    os.abort()


def hang() -> Iterator[dict[str, Any]]:
    """Answers once and never again."""
    yield {"step": 1}
    time.sleep(600)


def answer(text: str) -> Iterator[dict[str, Any]]:
    """Answers twice, and prints."""
    print("noise of a library", end="")
    yield {"step": 1}
    yield {"step": 2, "text": text}


def fail() -> Iterator[dict[str, Any]]:
    """Answers once and raises an error of ours."""
    yield {"step": 1}
    raise EngineError("is\nbroken", where="here", hint="repair it")


def leave() -> Iterator[dict[str, Any]]:
    """Answers once and exits."""
    yield {"step": 1}
    raise SystemExit(7)

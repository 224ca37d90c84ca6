"""Ends of processes that no handler sees."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any


class Killed(BaseException):
    """Nothing that runs after it may tidy up: stands for SIGKILL in this process."""


def crash(*_: str) -> Iterator[dict[str, Any]]:
    """Generator for ``run_child`` that ends its process by a segmentation fault."""
    os.kill(os.getpid(), signal.SIGSEGV)
    yield {}

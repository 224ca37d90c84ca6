"""What a driver does to the process that loads it."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any


def crash(*_: str) -> Iterator[dict[str, Any]]:
    """Generator for ``run_child`` that ends its process by a segmentation fault."""
    os.kill(os.getpid(), signal.SIGSEGV)
    yield {}

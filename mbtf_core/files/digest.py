"""SHA-256 of files and of plain data."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from mbtf_core.suggest import refuse_special


def file_sha256(path: Path) -> str:
    """SHA-256 of a regular file, in hexadecimal (what ``sha256sum`` prints)."""
    refuse_special(path)
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def data_sha256(data: Any) -> str:
    """SHA-256 of plain data as canonical JSON, in hexadecimal: the order of keys does not count."""
    return hashlib.sha256(json.dumps(data, sort_keys=True, separators=(",", ":")).encode()).hexdigest()

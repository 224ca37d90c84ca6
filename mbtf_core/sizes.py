"""Amounts of memory as people write them: ``500MB``, ``4GB``."""

from __future__ import annotations

import re

_SIZE = re.compile(r"^\s*(\d+(?:\.\d+)?(?:e\d+)?)\s*(B|kB|KB|MB|GB|TB)?\s*$")
_BYTES = {None: 1.0, "B": 1.0, "kB": 1e3, "KB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12}


def parse_size(text: str | float) -> float:
    """Bytes of ``"500MB"``, ``"4GB"``, or of a plain number of bytes; decimal units.

    Raises
    ------
    ValueError : none of these, or not positive
    """
    match = _SIZE.match(str(text))
    if match is None:
        raise ValueError("must be an amount of memory such as 500MB or 4GB")
    size = float(match[1]) * _BYTES[match[2]]
    if not 0 < size <= 1e18:
        raise ValueError("must be a positive amount of memory")
    return size


def format_size(size: float) -> str:
    """``500MB``, ``4GB``: the largest unit that needs no fraction."""
    for unit in ("TB", "GB", "MB", "kB"):
        if size >= _BYTES[unit] and size % _BYTES[unit] == 0:
            return f"{size / _BYTES[unit]:g}{unit}"
    return f"{size:g}"

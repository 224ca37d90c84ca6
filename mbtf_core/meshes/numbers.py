"""Numbers of text files, parsed at once."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.paths import opened


def parse(text: bytes, kind: type) -> NDArray[Any] | None:
    """Numbers, np.float64 or np.int64, between blanks and line breaks; None where one word is none."""
    if not text.strip():
        return np.zeros(0, kind)
    with warnings.catch_warnings():
        # Older versions of NumPy warn of words that are no numbers.
        warnings.simplefilter("error")
        try:
            return np.fromstring(text, kind, sep=" ")
        except (ValueError, DeprecationWarning):
            return None


def words_per_line(text: bytes) -> NDArray[np.int64]:
    """Number of words of each line."""
    return np.array([len(line.split()) for line in text.splitlines()], np.int64)


def read_bytes(path: Path) -> bytes:
    """Content of a file; an InputError where it cannot be read, or is empty."""
    with opened(path) as stream:
        data = stream.read()
    if not data:
        raise InputError("is empty", where=path)
    return data

"""Numbers of text files, parsed at once."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError


def parse(text: bytes, kind: type) -> NDArray[Any] | None:
    """Numbers between blanks and line breaks; None where one word is none.

    Parameters
    ----------
    text : bytes
        The words.
    kind : type
        Of the numbers, ``np.float64`` or ``np.int64``.
    """
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
    """Number of words of each line; all lines end with a line break."""
    if not text:
        return np.zeros(0, np.int64)
    return np.add.reduceat(_word_starts(text), _line_starts(text), dtype=np.int64)


def slashes_per_word(text: bytes) -> NDArray[np.int64]:
    """Number of slashes in each word, of which there are some."""
    starts = np.flatnonzero(_word_starts(text))
    return np.add.reduceat(_codes(text) == ord("/"), starts, dtype=np.int64)


def read_bytes(path: Path) -> bytes:
    """Content of a file.

    Raises
    ------
    InputError
        It cannot be read, or is empty.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None
    if not data:
        raise InputError("is empty", where=path)
    return data


def _codes(text: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(text, np.uint8)


def _word_starts(text: bytes) -> NDArray[np.bool_]:
    blank = _codes(text) <= ord(" ")
    starts = ~blank
    starts[1:] &= blank[:-1]
    return starts


def _line_starts(text: bytes) -> NDArray[np.int64]:
    return np.concatenate([[0], np.flatnonzero(_codes(text[:-1]) == ord("\n")) + 1])

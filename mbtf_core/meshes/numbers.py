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
    """Numbers between blanks and line breaks; None where one word is none.

    Parameters
    ----------
    text : the words
    kind : of the numbers, ``np.float64`` or ``np.int64``
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
    ends = np.flatnonzero(_codes(text) == ord("\n"))
    return np.diff(np.searchsorted(_word_starts(text), ends), prepend=0)


def slashes_per_word(text: bytes) -> NDArray[np.int64]:
    """Number of slashes in each word."""
    slashes = np.flatnonzero(_codes(text) == ord("/"))
    return np.diff(np.searchsorted(slashes, _word_starts(text)), append=len(slashes))


def read_bytes(path: Path) -> bytes:
    """Content of a file.

    Raises
    ------
    InputError : it cannot be read, or is empty
    """
    with opened(path) as stream:
        data = stream.read()
    if not data:
        raise InputError("is empty", where=path)
    return data


def _codes(text: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(text, np.uint8)


def _word_starts(text: bytes) -> NDArray[np.int64]:
    """Places of the first characters of all words."""
    blank = _codes(text) <= ord(" ")
    starts = ~blank
    starts[1:] &= blank[:-1]
    return np.flatnonzero(starts)

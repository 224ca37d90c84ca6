"""Channels of an EXR file, with the size checked before any pixel is read."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InputError


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Keep a native library's remarks on a broken file out of standard output and standard error."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = os.dup(1), os.dup(2)
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        with open(os.devnull, "w") as nothing, contextlib.redirect_stdout(nothing):
            yield
    finally:
        os.dup2(saved[0], 1)
        os.dup2(saved[1], 2)
        for handle in (*saved, sink):
            os.close(handle)


def _window(header: dict[str, Any], name: str) -> tuple[int, int, int, int]:
    low, high = header[name]
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def read_file(path: Path, max_pixels: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Header of the first part of an EXR file, and its channels (H, W) by name, float16 or float32.

    Raises
    ------
    InputError : broken, more than `max_pixels`, cropped (data window unlike the display window), deep,
        subsampled, or channels of whole numbers
    """
    import OpenEXR

    broken = InputError("cannot be read as an EXR image: it is damaged or cut short", where=path)
    try:
        with _silenced():
            head = OpenEXR.File(str(path), separate_channels=True, header_only=True).header()
    except Exception:  # a damaged file may make the library raise anything
        raise broken from None
    if head["type"] not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise InputError("deep EXR images are not supported", where=path, cure="flatten the image")
    window = _window(head, "dataWindow")
    columns, rows = window[2] - window[0] + 1, window[3] - window[1] + 1
    if rows * columns > max_pixels:
        raise InputError(f"claims {columns} x {rows} pixels; at most {max_pixels:,} are read", where=path)
    if window != _window(head, "displayWindow"):
        raise InputError(
            "data window and display window differ: a cropped tile", where=path, cure="crop the image"
        )
    if any(c.xSampling != 1 or c.ySampling != 1 for c in head["channels"]):
        raise InputError("subsampled EXR channels are not supported", where=path, cure="save it as plain RGB")
    try:
        with _silenced(), OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except Exception:
        raise broken from None
    if not channels or any(c.shape != (rows, columns) for c in channels.values()):
        raise broken
    for name, channel in channels.items():
        if channel.dtype.kind != "f":
            raise InputError(
                f"channel '{name}' holds whole numbers", where=path, cure="save it as half or float"
            )
    return head, channels


def read_channels(path: Path, max_pixels: int) -> dict[str, NDArray[Any]]:
    """The channels of :func:`read_file` alone."""
    return read_file(path, max_pixels)[1]

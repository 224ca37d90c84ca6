"""Sixteen-bit color PNG without loss (the common image library keeps only the upper eight bits).

Follows the PNG specification (third edition, W3C 2025): chunks, filters of method 0, Adam7 interlace.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
# First row and column, and their steps, of the passes of Adam7.
_PASSES = ((0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1))
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}


def header(data: bytes) -> tuple[int, int, int, int, int] | None:
    """(columns, rows, bits, channels, interlace) of a PNG file's first bytes; None where it is no PNG."""
    if len(data) < 29 or data[:8] != SIGNATURE or data[12:16] != b"IHDR":
        return None
    columns, rows = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    return columns, rows, data[24], _CHANNELS.get(data[25], 0), data[28]


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """(type, content) of the chunks up to the end mark; ValueError where one is damaged or cut short."""
    at = 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        kind, content = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        checksum = data[at + 8 + length : at + 12 + length]
        if zlib.crc32(content, zlib.crc32(kind)) != int.from_bytes(checksum, "big") or len(checksum) < 4:
            raise ValueError(f"chunk {kind!r} is damaged")
        if kind == b"IEND":
            return
        yield kind, content
        at += 12 + length
    raise ValueError("file ends early")


def read_png16(path: Path) -> NDArray[np.uint16]:
    """Codes (H, W, C) of a 16-bit PNG of any channel count. The caller has checked the size.

    Raises
    ------
    InputError : damaged or cut short
    """
    data = path.read_bytes()
    head = header(data)
    if head is None or head[2] != 16 or not head[3]:
        raise InputError("is not a 16-bit PNG image", where=path)
    columns, rows, _, channels, interlace = head
    passes = _PASSES if interlace else ((0, 0, 1, 1),)
    sizes = [(-(-(rows - y) // dy), -(-(columns - x) // dx)) for y, x, dy, dx in passes]
    size = 2 * channels
    length = sum(h * (w * size + 1) for h, w in sizes if h > 0 and w > 0)
    try:
        stream = zlib.decompressobj()
        packed = b"".join(content for kind, content in _chunks(data) if kind == b"IDAT")
        raw = stream.decompress(packed, length)
    except (ValueError, zlib.error) as error:
        raise InputError(f"cannot be read as a PNG image ({error})", where=path) from None
    if len(raw) != length:
        raise InputError("cannot be read as a PNG image (file ends early)", where=path)
    out, at = np.empty((rows, columns, channels), np.uint16), 0
    for (y, x, dy, dx), (h, w) in zip(passes, sizes, strict=True):
        if h <= 0 or w <= 0:
            continue
        lines = np.frombuffer(raw, np.uint8, h * (w * size + 1), at).reshape(h, w * size + 1)
        at += lines.size
        if lines[:, 0].max() > 4:
            raise InputError("cannot be read as a PNG image (unknown filter)", where=path)
        pixels = _unfilter(lines[:, 0], lines[:, 1:].reshape(h, w, size))
        out[y::dy, x::dx] = pixels.reshape(h, w, channels, 2).view(">u2")[..., 0]
    return out


def _unfilter(kinds: NDArray[np.uint8], filtered: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Undo line filters 0 none, 1 left, 2 up, 3 average, 4 Paeth; bytes (rows, columns, bytes per pixel).

    A byte depends on its left, upper and upper left neighbors, so all pixels of one anti-diagonal are
    independent: the image is swept diagonal by diagonal.
    """
    rows, columns, size = filtered.shape
    # One row above and one pixel to the left are zero.
    out = np.zeros((rows + 1, columns + 1, size), np.uint8)
    for diagonal in range(rows + columns - 1):
        y = np.arange(max(0, diagonal - columns + 1), min(rows, diagonal + 1))
        x = diagonal - y
        left = out[y + 1, x].astype(np.int16)
        up = out[y, x + 1].astype(np.int16)
        corner = out[y, x].astype(np.int16)
        guess = left + up - corner
        to_left, to_up, to_corner = np.abs(guess - left), np.abs(guess - up), np.abs(guess - corner)
        paeth = np.where(
            (to_left <= to_up) & (to_left <= to_corner), left, np.where(to_up <= to_corner, up, corner)
        )
        kind = kinds[y][:, None]
        predicted = np.choose(kind, [np.zeros_like(left), left, up, (left + up) >> 1, paeth])
        out[y + 1, x + 1] = (filtered[y, x] + predicted).astype(np.uint8)
    return out[1:, 1:]

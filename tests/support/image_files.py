"""Image files written from their specification or by other libraries, for tests of the readers."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .image_samples import png_chunk


def rng() -> np.random.Generator:
    """A generator that gives the same numbers in every test."""
    return np.random.default_rng(7)


def scan_lines(codes: NDArray[Any], bits: int, filters: list[int] | None = None) -> bytes:
    """Filtered lines of codes (H, W, C), a filter per line (cycled)."""
    rows, columns, channels = codes.shape
    size = channels * bits // 8
    raw = np.ascontiguousarray(codes.astype(">u2" if bits == 16 else "u1")).tobytes()
    lines = np.frombuffer(raw, np.uint8).reshape(rows, columns * size).astype(int)
    out = b""
    for y in range(rows):
        kind = (filters or [0])[y % len(filters or [0])]
        line = lines[y]
        up = lines[y - 1] if y else np.zeros_like(line)
        left = np.concatenate([np.zeros(size, int), line[:-size]])
        corner = np.concatenate([np.zeros(size, int), up[:-size]])
        estimate = left + up - corner
        distances = np.abs(np.stack([estimate - left, estimate - up, estimate - corner]))
        paeth = np.choose(np.argmin(distances, axis=0), [left, up, corner])
        predicted = [np.zeros_like(line), left, up, (left + up) // 2, paeth][kind]
        out += bytes([kind]) + ((line - predicted) % 256).astype(np.uint8).tobytes()
    return out


# Slices of the seven passes of Adam7, from the specification's picture.
ADAM7 = [
    (slice(y, None, dy), slice(x, None, dx))
    for y, dy, x, dx in (
        *((0, 8, 0, 8), (0, 8, 4, 8), (4, 8, 0, 4), (0, 4, 2, 4)),
        *((2, 4, 0, 2), (0, 2, 1, 2), (1, 2, 0, 1)),
    )
]


def png(
    path: Path,
    codes: NDArray[Any],
    color: int,
    bits: int,
    filters: list[int] | None = None,
    *,
    interlace: bool = False,
    extra: tuple[tuple[bytes, bytes], ...] = (),
) -> Path:
    """Write a PNG from its specification; `extra` chunks stand before the pixels."""
    rows, columns, _ = codes.shape
    out = b"".join(
        scan_lines(codes[part], bits, filters) for part in (ADAM7 if interlace else [...]) if codes[part].size
    )
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + png_chunk(b"IHDR", struct.pack(">IIBBBBB", columns, rows, bits, color, 0, 0, int(interlace)))
        + b"".join(png_chunk(*c) for c in extra)
        + png_chunk(b"IDAT", zlib.compress(out))
        + png_chunk(b"IEND", b"")
    )
    return path


def exr(path: Path, channels: dict[str, NDArray[Any]], **header: Any) -> Path:
    import OpenEXR

    head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(head, dict(channels)).write(str(path))
    return path

"""Image files written from their specification or by other libraries, for tests of the readers."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .image_samples import packed_png


def rng() -> np.random.Generator:
    """A generator that gives the same numbers in every test."""
    return np.random.default_rng(7)


def png(
    path: Path, codes: NDArray[Any], color: int, bits: int, *, extra: tuple[tuple[bytes, bytes], ...] = ()
) -> Path:
    """Write codes (H, W, C) as a PNG, from its specification."""
    rows, columns, _ = codes.shape
    lines = codes.astype(">u2" if bits == 16 else "u1").tobytes()
    size = len(lines) // rows
    out = b"".join(b"\0" + lines[y * size : (y + 1) * size] for y in range(rows))
    path.write_bytes(packed_png(columns, rows, bits, color, zlib.compress(out), *extra))
    return path


def exr(path: Path, channels: dict[str, NDArray[Any]], **header: Any) -> Path:
    import OpenEXR

    head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(head, dict(channels)).write(str(path))
    return path


def icc(name: str, columns: Sequence[Sequence[float]], curve: bytes, gray: bool = False) -> bytes:
    """An ICC profile of version 4: XYZ (D50) of red, green and blue, and one curve element for all."""

    def padded(content: bytes) -> bytes:
        return content + bytes(-len(content) % 4)

    text = name.encode("utf-16-be")
    tags = {b"desc": b"mluc" + struct.pack(">IIIHHII", 0, 1, 12, 0x656E, 0x5553, len(text), 28) + text}
    tags[b"wtpt"] = b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(65536 * n) for n in (0.9642, 1, 0.8249)))
    if gray:
        tags[b"kTRC"] = curve
    else:
        for key, column in zip(b"rgb", columns, strict=True):
            tags[bytes([key]) + b"XYZ"] = b"XYZ \0\0\0\0" + struct.pack(
                ">3i", *(round(65536 * n) for n in column)
            )
            tags[bytes([key]) + b"TRC"] = curve
    body, table, offset = b"", struct.pack(">I", len(tags)), 132 + 12 * len(tags)
    for key, content in tags.items():
        table += struct.pack(">4sII", key, offset + len(body), len(content))
        body += padded(content)
    head = struct.pack(">I4sI4s4s4s", offset + len(body), b"lcms", 0x04200000, b"mntr", b"RGB ", b"XYZ ")
    if gray:
        head = head.replace(b"RGB ", b"GRAY")
    head += struct.pack(">6H4s", 2026, 1, 1, 0, 0, 0, b"acsp") + bytes(28)
    head += struct.pack(">3i", *(round(65536 * n) for n in (0.9642, 1, 0.8249)))
    return head + bytes(128 - len(head)) + table + body


# Colorants of Display P3 in its profile by Apple.
P3_COLUMNS = ((0.51512, 0.2412, -0.00105), (0.29198, 0.69225, 0.04189), (0.1571, 0.06657, 0.78407))
# The curve of sRGB as a parametric element.
SRGB_CURVE = b"para\0\0\0\0\0\3\0\0" + struct.pack(
    ">5i", *(round(65536 * n) for n in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045))
)

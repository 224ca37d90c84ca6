"""Limits of what an image file may claim, checked before any pixel is allocated."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.errors import InputError

# Largest image that is read by default (11 585² pixels).
MAX_PIXELS = 2**27

# Pixels of a byte of the file, at most (PNG reaches 1032 : 1, with 8 pixels in a byte).
_PIXELS_PER_BYTE = 1 << 14
# Decoded bytes up to which any compression is accepted, and the ratio that is accepted beyond.
_ANY_RATIO, _MAX_RATIO = 1 << 29, 1 << 10


def check_size(path: Path, rows: int, columns: int, max_pixels: int, pixel_bytes: int = 1) -> None:
    """Refuse an image by the size that its header claims: no pixels, more than `max_pixels`, or more than the
    file can hold; or over 512 MiB of pixels, of `pixel_bytes` each, from a file of less than 1/1024 of
    that."""
    pixels = rows * columns
    if rows <= 0 or columns <= 0:
        raise InputError("contains no pixels", where=path)
    if pixels > max_pixels:
        raise InputError(
            f"claims {columns} x {rows} pixels; at most {max_pixels:,} are read",
            where=path,
            # Files of our own are limited by their size alone.
            hint=f"reduce it; as a map of mbtf-gen, --set geometry.max_pixels={pixels} reads it"
            if max_pixels >= MAX_PIXELS
            else "",
        )
    size = path.stat().st_size
    if pixels > _PIXELS_PER_BYTE * size:
        raise InputError(f"is cut short: {size} bytes cannot hold {columns} x {rows} pixels", where=path)
    if pixels * pixel_bytes > max(_ANY_RATIO, _MAX_RATIO * size):
        raise InputError(
            f"claims {columns} x {rows} pixels, {pixels * pixel_bytes / 2**30:.2g} GiB, in {size:,} bytes",
            where=path,
            hint="it is cut short, or almost all of it is alike: reduce it",
        )

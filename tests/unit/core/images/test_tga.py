"""TGA files, written from their specification: origins, run lengths, palettes, alpha; truncated ones."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.image_files import rng

from mbtf_core.images.read import read_image

Codes = NDArray[np.uint8]


def write(path: Path, codes: Codes, origin: int, *, runs: bool, palette: Codes | None = None) -> Path:
    """Codes (H, W, C), gray, gray and alpha, RGB or RGBA, or indices of a palette (n, 3)."""
    rows, columns, channels = codes.shape
    kind = 1 if palette is not None else 3 if channels < 3 else 2
    order = [2, 1, 0, 3][:channels] if channels > 2 else list(range(channels))
    stored = codes[..., order]
    stored = stored if origin & 0x20 else stored[::-1]
    stored = stored[:, ::-1] if origin & 0x10 else stored
    head = struct.pack(
        "<BBBHHBHHHHBB",
        3,  # length of the text behind the header
        int(palette is not None),
        kind + 8 * runs,
        0,
        0 if palette is None else len(palette),
        0 if palette is None else 24,
        *(0, 0, columns, rows),
        8 * channels,
        origin | (8 if channels in (2, 4) else 0),
    )
    table = b"" if palette is None else palette[:, ::-1].tobytes()
    pixels = [bytes(pixel) for line in stored for pixel in line]
    body = b"".join(_runs(pixels)) if runs else b"".join(pixels)
    path.write_bytes(head + b"abc" + table + body)
    return path


def _runs(pixels: list[bytes]) -> list[bytes]:
    """Packets of two pixels: a run where they are equal, else as they are."""
    pairs = zip(pixels[::2], pixels[1::2], strict=True)
    return [b"\x81" + a if a == b else b"\x01" + a + b for a, b in pairs]


@pytest.mark.parametrize("runs", [False, True])
@pytest.mark.parametrize("origin", [0x00, 0x10, 0x20, 0x30])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_every_code_is_in_its_place(tmp_path: Path, channels: int, origin: int, runs: bool) -> None:
    codes = rng().integers(0, 256, (5, 6, channels)).astype(np.uint8)
    codes[2] = codes[2, :1]  # runs
    image = read_image(write(tmp_path / "x.tga", codes, origin, runs=runs))
    assert image.bits == 8
    assert np.array_equal(np.rint(255 * image.pixels), codes)


def test_a_palette(tmp_path: Path) -> None:
    palette = rng().integers(0, 256, (4, 3)).astype(np.uint8)
    codes = rng().integers(0, 4, (5, 6, 1)).astype(np.uint8)
    image = read_image(write(tmp_path / "x.TGA", codes, 0, runs=True, palette=palette))
    assert np.array_equal(np.rint(255 * image.pixels), palette[codes[..., 0]])

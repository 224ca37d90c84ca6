"""Linear images of the page: constant relative error, and lossless compression."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from mbtf_pipeline.report.linear_images import EXPOSURE_STOPS, STOPS_BELOW, Coding, pack


def unpacked(data: bytes, rows: int, columns: int) -> np.ndarray:
    """Codes (rows, columns, 3), decoded pixel by pixel."""
    planes = np.frombuffer(zlib.decompress(data), np.uint8).reshape(3, 2, rows, columns).astype(int)
    folded = planes[:, 0] + 256 * planes[:, 1]
    rest = np.where(folded % 2, -(folded + 1) // 2, folded // 2)
    channels = np.zeros_like(rest)
    for y in range(rows):
        for x in range(columns):
            left = channels[:, y, x - 1] if x else 0
            up = channels[:, y - 1, x] if y else 0
            channels[:, y, x] = rest[:, y, x] + (left + up) // 2
    g, r, b = channels
    return np.stack([r + g, g, b + g], axis=-1)


@pytest.mark.parametrize("bits", [8, 10])
def test_compression_is_lossless(bits: int) -> None:
    codes = np.random.default_rng(bits).integers(0, 1 << bits, (7, 5, 3)).astype(np.int32)
    codes[0, 0], codes[3, 2] = 0, (1 << bits) - 1
    assert (unpacked(pack(codes), 7, 5) == codes).all()


@pytest.mark.parametrize("bits", [8, 9, 10])
def test_the_relative_error_is_constant(bits: int) -> None:
    picture = np.geomspace(1e-4, 30.0, 3000).astype(np.float32).reshape(50, 20, 3)
    coding = Coding.spanning([picture], 0.5, bits)
    found = coding.decode(coding.encode(picture))
    relative = np.abs(found / picture - 1)
    assert relative.max() <= coding.relative_error * 1.001
    assert relative.max() > 0.8 * coding.relative_error
    assert coding.encode(picture).max() == coding.largest


def test_black_stays_black_and_invalid_values_are_clipped() -> None:
    picture = np.array([[[0.0, -1.0, np.nan], [np.inf, 1e30, 1.0]]], np.float32)
    coding = Coding.spanning([np.ones((1, 1, 3), np.float32)], 1.0, 10)
    codes = coding.encode(picture)
    assert codes.tolist() == [[[0, 0, 0], [coding.largest] * 3]]
    assert coding.decode(codes)[0, 0].tolist() == [0, 0, 0]


def test_values_below_the_scale_are_black_at_every_exposure() -> None:
    dim = np.full((2, 2, 3), 1e-12, np.float32)
    coding = Coding.spanning([dim, np.ones_like(dim)], 1.0, 10)
    assert coding.low == 2.0**-STOPS_BELOW
    # The largest such value at the highest exposure, in steps of an 8-bit sRGB display.
    assert 255 * 12.92 * coding.low * 2.0**EXPOSURE_STOPS < 3.5

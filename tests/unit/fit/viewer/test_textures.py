"""Textures of a page: what a reader written from their description gets back."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_fit.viewer.textures import pack


def unpack(description: dict[str, Any]) -> list[NDArray[np.float64]]:
    """The texels, number by number."""
    numbers = zlib.decompress(base64.b64decode(description["data"]))
    bits = description["bits"]
    total = len(numbers) // (2 if bits > 8 else 1)
    at, out = 0, []
    for level, (rows, columns) in enumerate(description["shapes"]):
        texels = np.zeros((rows, columns, description["channels"]))
        before = np.zeros((rows, columns), int)
        for c in range(description["channels"]):
            whole = np.zeros((rows, columns), int)
            for j in range(rows):
                for i in range(columns):
                    difference = numbers[at] + (numbers[total + at] << 8 if bits > 8 else 0)
                    at += 1
                    if i and j:
                        left, above, corner = whole[j, i - 1], whole[j - 1, i], whole[j - 1, i - 1]
                        guess = sorted((left, above, left + above - corner))[1]
                    else:
                        guess = whole[j, i - 1] if i else whole[j - 1, i] if j else 0
                    base = before[j, i] if description["alike"] else 0
                    whole[j, i] = (base + guess + difference) % 2**bits - base
            number = whole + before if description["alike"] else whole
            before = number
            texels[..., c] = description["low"][level][c] + description["step"][level][c] * number
        out.append(texels)
    assert at == total
    return out


@pytest.mark.parametrize("alike", [False, True])
@pytest.mark.parametrize("bits", [6, 8, 16])
def test_texels_are_rounded_to_their_range(bits: int, alike: bool) -> None:
    random = np.random.default_rng(0)
    levels = [random.normal(size=(rows, 2 * rows, 3)).astype(np.float32) * (1, 10, 0) for rows in (1, 2, 7)]
    levels[2][3, 4, 0] = 40.0
    packed = pack([np.asarray(texels, np.float32) for texels in levels], bits, alike=alike)
    for found, given, kept in zip(unpack(packed.description), levels, packed.levels, strict=True):
        step = np.ptp(given, axis=(0, 1)) / (2**bits - 1)
        assert (np.abs(found - given) <= 0.5001 * step + 1e-6).all()
        np.testing.assert_allclose(kept, found, atol=1e-6 * np.abs(given).max())


def test_smooth_textures_compress_well() -> None:
    x = np.linspace(0, 6, 128)
    smooth = np.sin(x)[:, None, None] * np.cos(x)[None, :, None] * np.ones(2)
    assert len(pack([smooth.astype(np.float32)]).description["data"]) < 0.5 * smooth.size


def test_infinite_texels_are_refused() -> None:
    with pytest.raises(InputError, match="not finite"):
        pack([np.full((2, 2, 1), np.inf, np.float32)])

"""Textures of a page; the browser tests compare what the page reads of them."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_core.errors import InputError
from mbtf_fit.viewer.textures import pack


@pytest.mark.parametrize("alike", [False, True])
@pytest.mark.parametrize("bits", [6, 16])
def test_texels_are_rounded_to_their_range(bits: int, alike: bool) -> None:
    random = np.random.default_rng(0)
    levels = [random.normal(size=(rows, 2 * rows, 3)).astype(np.float32) * (1, 10, 0) for rows in (1, 2, 7)]
    levels[2][3, 4, 0] = 40.0
    packed = pack([np.asarray(texels, np.float32) for texels in levels], bits, alike=alike)
    for found, given in zip(packed.levels, levels, strict=True):
        step = np.ptp(given, axis=(0, 1)) / (2**bits - 1)
        assert (np.abs(found - given) <= 0.5001 * step + 1e-5).all()


def test_smooth_textures_compress_well() -> None:
    x = np.linspace(0, 6, 128)
    smooth = np.sin(x)[:, None, None] * np.cos(x)[None, :, None] * np.ones(2)
    assert len(pack([smooth.astype(np.float32)]).description["data"]) < 0.5 * smooth.size
    with pytest.raises(InputError, match="not finite"):
        pack([np.full((2, 2, 1), np.inf, np.float32)])

"""Pictures of the whole sphere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mbtf_core.errors import InputError
from mbtf_core.images.environment import read_environment


def test_surroundings_are_linear_and_small(tmp_path: Path) -> None:
    sky = np.zeros((200, 400, 3), np.float32)
    sky[:100] = (0.25, 0.5, 4.0)
    np.save(tmp_path / "sky.npy", sky)
    values = read_environment(tmp_path / "sky.npy", 64)
    assert values.shape == (64, 128, 3)
    np.testing.assert_allclose(values[:31], np.broadcast_to(sky[0, 0], (31, 128, 3)), rtol=1e-5)
    assert values[34:].max() == 0
    Image.fromarray(np.full((2, 4, 3), 188, np.uint8)).save(tmp_path / "gray.png")
    np.testing.assert_allclose(read_environment(tmp_path / "gray.png", 64), 0.5029, rtol=1e-3)
    # Radiance's RGBE: a mantissa of 128 and an exponent of 129 are 1.
    pixels = bytes([128, 64, 32, 129]) * 8
    (tmp_path / "one.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n" + pixels)
    one = read_environment(tmp_path / "one.hdr", 64)
    np.testing.assert_allclose(one[0, 0], (1, 0.5, 0.25), rtol=0.01)
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"
    for content, what in (
        (head + b"-Y 60000 +X 60000\n" + pixels, "claims 60000 x 60000"),
        (head + b"+X 4 +Y 2\n" + pixels, "turned"),
        (head.replace(b"rgbe", b"xyze") + b"-Y 2 +X 4\n" + pixels, "XYZ"),
        (b"#?RADIANCE\n", "Radiance picture"),
    ):
        (tmp_path / "bad.hdr").write_bytes(content)
        with pytest.raises(InputError, match=what):
            read_environment(tmp_path / "bad.hdr", 64)

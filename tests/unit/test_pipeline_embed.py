"""Embedded pictures: colours of differences, and a budget that holds."""

from __future__ import annotations

import base64
import io

import numpy as np
import pytest
from PIL import Image

from mbtf_pipeline.embed import (
    ENCODINGS,
    difference_picture,
    difference_scale,
    embed,
    round_scale,
    signed_colours,
)


def decoded(uri: str) -> np.ndarray:
    head, _, data = uri.partition(",")
    assert head in ("data:image/png;base64", "data:image/jpeg;base64")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))


def test_sign_and_size_of_a_difference_can_be_told() -> None:
    colours = signed_colours(np.array([-1.0, -0.5, 0.0, 0.5, 1.0, 7.0, np.nan])).astype(int)
    luma = colours @ [0.2126, 0.7152, 0.0722]
    assert luma[2] < 20
    assert luma[1] < luma[0]
    assert luma[3] < luma[4]
    assert colours[0, 2] > colours[0, 0]
    assert colours[4, 0] > colours[4, 2]
    assert (colours[5] == colours[4]).all()
    assert (colours[6] == colours[2]).all()


def test_difference_is_fit_minus_reference() -> None:
    dark, bright = np.full((2, 2, 3), 0.1, np.float32), np.full((2, 2, 3), 0.3, np.float32)
    assert (difference_picture(bright, dark, 0.2) == signed_colours(np.ones((2, 2)))).all()
    assert (difference_picture(dark, bright, 0.4) == signed_colours(np.full((2, 2), -0.5))).all()


@pytest.mark.parametrize(
    ("x", "expected"), [(0.011, 0.02), (0.02, 0.02), (0.3, 0.5), (7.0, 10.0), (0.0, 1.0), (np.nan, 1.0)]
)
def test_scales_are_round(x: float, expected: float) -> None:
    assert round_scale(x) == pytest.approx(expected)


def test_one_scale_for_all_pairs() -> None:
    zero = np.zeros((10, 10, 3), np.float32)
    assert difference_scale([(zero + 0.03, zero), (zero, zero)], white=0.5) == pytest.approx(0.1)
    assert difference_scale([], white=1.0) == 1.0


def test_the_best_encoding_that_fits() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (128, 128, 3), np.uint8)
    pictures = {"a": lambda: noise, "b": lambda: noise[::-1]}
    uris, encoding = embed(pictures, 1e6)
    assert encoding is ENCODINGS[0]
    assert (decoded(uris["a"]) == noise).all()
    smaller, encoding = embed(pictures, 80_000)
    assert encoding.quality is not None
    assert sum(map(len, smaller.values())) <= 80_000
    assert decoded(smaller["b"]).shape == (128, 128, 3)
    smallest, encoding = embed(pictures, 1.0)
    assert encoding is ENCODINGS[-1]
    assert decoded(smallest["a"]).shape == (16, 16, 3)

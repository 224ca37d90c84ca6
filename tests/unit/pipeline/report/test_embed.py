"""Images of the report: encodings within a size limit, and pixels that match their sources."""

from __future__ import annotations

import base64
import io

import numpy as np
import pytest
from PIL import Image

from mbtf_core.color import to_display
from mbtf_pipeline.report.embed import ENCODINGS, Encoding, Gallery, encode, shrink
from mbtf_pipeline.report.error_maps import palette


def decoded(uri: str) -> np.ndarray:
    head, _, data = uri.partition(",")
    assert head in ("data:image/png;base64", "data:image/jpeg;base64")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))


@pytest.fixture
def gallery() -> Gallery:
    noise = np.random.default_rng(1).random((96, 128, 3)).astype(np.float32)
    values = np.tile(np.linspace(0, 1, 128), (96, 1))
    linear = {"a": noise, "b": 3 * noise[::-1]}
    return Gallery(1.0, linear, {"map": ("local", values), "offset": ("signed", 2 * values - 1)})


def test_every_encoding_is_smaller_than_the_one_before(gallery: Gallery) -> None:
    def size(encoding: Encoding) -> int:
        return sum(map(len, encode(gallery, encoding).values()))

    sizes = [size(encoding) for encoding in ENCODINGS]
    assert sizes == sorted(sizes, reverse=True)


def test_reductions_are_reported(gallery: Gallery) -> None:
    assert ENCODINGS[0].describe() == "PNG"
    small = ENCODINGS[-2]
    assert "reduced to limit the file size: 8 × 8 pixels averaged" in small.describe()
    assert decoded(encode(gallery, small)["a"]).shape == (96 // 8, 128 // 8, 3)


def test_images_match_their_sources(gallery: Gallery) -> None:
    images = encode(gallery, ENCODINGS[0])
    assert (decoded(images["b"]) == to_display(gallery.linear["b"], 1.0)).all()
    colors = decoded(images["map"])
    assert colors[0, 0].tolist() == list(palette("local")[0])
    assert colors[0, -1].tolist() == list(palette("local")[-1])
    assert decoded(images["offset"])[0, 64].max() < 40


def test_averaging_preserves_the_mean() -> None:
    x = np.arange(6 * 9, dtype=float).reshape(6, 9)
    assert shrink(x, 3).shape == (2, 3)
    assert shrink(x, 3).mean() == pytest.approx(x.mean())
    assert shrink(x, 4).tolist() == [[x[:4, :4].mean(), x[:4, 4:8].mean()]]
    assert shrink(np.ones((5, 3, 3)), 16).shape == (1, 1, 3)

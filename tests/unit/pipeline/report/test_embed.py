"""Images of the report: encodings within a size limit, and previews that match their sources."""

from __future__ import annotations

import base64
import io

import numpy as np
import pytest
from PIL import Image

from mbtf_gen.pictures.reference import to_display
from mbtf_pipeline.report.embed import ENCODINGS, Gallery, embed, encode, shrink
from mbtf_pipeline.report.error_maps import palette


def decoded(uri: str) -> np.ndarray:
    head, _, data = uri.partition(",")
    assert head in ("data:image/png;base64", "data:image/jpeg;base64")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))


@pytest.fixture
def gallery() -> Gallery:
    noise = np.random.default_rng(1).random((96, 128, 3)).astype(np.float32)
    values = np.tile(np.linspace(0, 1, 128), (96, 1))
    linear = {"a": lambda: noise, "b": lambda: 3 * noise[::-1]}
    return Gallery(0.5, linear, {"map": ("local", values), "offset": ("signed", 2 * values - 1)})


def test_the_best_encoding_within_the_limit_is_used(gallery: Gallery) -> None:
    assert embed(gallery, 1e9).encoding is ENCODINGS[0]
    sizes = [encode(gallery, e).size for e in ENCODINGS]
    assert sizes == sorted(sizes, reverse=True)
    for size, encoding in zip(sizes, ENCODINGS, strict=True):
        assert embed(gallery, size).encoding is encoding
    assert embed(gallery, 1.0).encoding is ENCODINGS[-1]


def test_reductions_are_reported(gallery: Gallery) -> None:
    best, small = embed(gallery, 1e9), embed(gallery, 3e4)
    assert "averaged" not in best.encoding.describe(best.coding)
    s = small.encoding.shrink
    assert s > 1
    expected = f"reduced to limit the file size: {s} × {s} pixels averaged"
    assert expected in small.encoding.describe(small.coding)
    assert small.packed["a"]["columns"] == 128 // s


def test_previews_match_their_sources(gallery: Gallery) -> None:
    found = embed(gallery, 1e9)
    shown = decoded(found.images["b"]).astype(int)
    assert np.abs(shown - to_display(gallery.linear["b"](), 1 / 0.5)).mean() < 7
    colors = decoded(found.images["map"])
    assert colors[0, 0].tolist() == list(palette("local")[0])
    assert colors[0, -1].tolist() == list(palette("local")[-1])
    assert decoded(found.images["offset"])[0, 64].max() < 40


def test_averaging_preserves_the_mean() -> None:
    x = np.arange(6 * 9, dtype=float).reshape(6, 9)
    assert shrink(x, 3).shape == (2, 3)
    assert shrink(x, 3).mean() == pytest.approx(x.mean())
    assert shrink(x, 4).tolist() == [[x[:4, :4].mean(), x[:4, 4:8].mean()]]
    assert shrink(np.ones((5, 3, 3)), 16).shape == (1, 1, 3)

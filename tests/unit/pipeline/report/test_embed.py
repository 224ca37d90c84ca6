"""Images and maps of the report: pixels that match their sources, noise-free errors, palettes and scales."""

from __future__ import annotations

import base64
import io

import numpy as np
import pytest
from PIL import Image

from mbtf_core.color import palette, robust_scale, to_display
from mbtf_pipeline.report.images import REDUCTIONS, linear_uri, map_uri, scaled_maps


def decoded(uri: str) -> np.ndarray:
    head, _, data = uri.partition(",")
    assert head in ("data:image/png;base64", "data:image/jpeg;base64")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))


def test_images_match_their_sources_and_shrink() -> None:
    picture = np.random.default_rng(1).random((96, 128, 3)).astype(np.float32)
    assert (decoded(linear_uri(picture, 1.0)) == to_display(picture, 1.0)).all()
    assert decoded(linear_uri(picture, 1.0, 8)).shape == (96 // 8, 128 // 8, 3)
    values = np.tile(np.linspace(0, 1, 128), (96, 1))
    assert (decoded(map_uri(values, "local"))[0, [0, -1]] == palette("local")[[0, -1]]).all()
    assert decoded(map_uri(2 * values - 1, "signed"))[0, 64].max() < 40
    sizes = [len(linear_uri(picture, 1.0, n)) + len(map_uri(values, "flip", n)) for n in REDUCTIONS]
    assert sizes == sorted(sizes, reverse=True)


def test_a_diverged_fit_is_clipped_and_marked() -> None:
    """It does not widen the scale of the others; fits that differ by less keep one scale."""
    ramp = np.linspace(0, 0.1, 400).reshape(20, 20)
    assert robust_scale([[ramp], [2 * ramp]]) == robust_scale([[2 * ramp]])
    fits = {"good": {"g": ramp}, "fair": {"f": 2 * ramp}, "diverged": {"d": 1e4 * ramp}}
    bars, images, beyond = scaled_maps({"local": fits, "signed": {"good": {"g": ramp}}})
    assert bars["local"]["ticks"] == ["0", "5", "10", "15", "≥ 20"]
    assert not any("≥" in tick for tick in bars["signed"]["ticks"])
    assert list(beyond) == ["d-local"]
    assert beyond["d-local"] == pytest.approx(1, abs=0.01)
    assert (decoded(images["f-local"](1))[-1, -1] == palette("local")[-1]).all()

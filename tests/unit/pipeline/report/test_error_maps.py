"""Error maps are noise-free, color maps encode magnitude by lightness, and scales are round."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_pipeline.report.error_maps import color_bar, common_scale, indices, local_error, palette


def luma(colors: np.ndarray) -> np.ndarray:
    return np.asarray(colors, float) @ [0.2126, 0.7152, 0.0722]


def test_local_error_is_not_biased_by_noise() -> None:
    random = np.random.default_rng(1)
    truth = np.full((96, 96, 3), 0.5)
    a, b = (truth + 0.2 * random.standard_normal(truth.shape) for _ in range(2))
    picture = truth.copy()
    picture[:, 48:] += 0.3
    found = local_error(picture, a, b)
    assert found[:, 56:].mean() == pytest.approx(0.3, rel=0.05)
    # Without an error, the map lies far below the noise, and half of it is 0.
    assert np.median(found[:, :40]) < 0.05
    assert 0.3 < np.mean(found[:, :40] == 0) < 0.7
    assert (found >= 0).all()


@pytest.mark.parametrize("name", ["local", "flip"])
def test_lightness_encodes_magnitude(name: str) -> None:
    lightness = luma(palette(name))  # type: ignore[arg-type]
    assert np.diff(lightness).min() > -0.6
    assert lightness[-1] - lightness[0] > 150


def test_signed_colors_encode_sign_and_magnitude() -> None:
    table = np.array(palette("signed"))
    colors = table[indices([-1.0, -0.5, 0.0, 0.5, 1.0, 7.0, np.nan], "signed")].astype(int)
    shades = luma(colors)
    assert shades[2] < 20
    assert shades[1] < shades[0]
    assert shades[3] < shades[4]
    assert colors[0, 2] > colors[0, 0]
    assert colors[4, 0] > colors[4, 2]
    assert (colors[5] == colors[4]).all()
    assert (colors[6] == colors[2]).all()
    assert indices([-1.0, 0.0, 0.5, 1.0, 9.0], "local").tolist() == [0, 0, 128, 255, 255]


def test_scales_are_round() -> None:
    for size, expected in {0.011: 0.02, 0.02: 0.02, 0.3: 0.5, 7.0: 10.0, 0.0: 1.0}.items():
        assert common_scale([np.full(100, size)]) == pytest.approx(expected)
    zero = np.zeros((10, 10))
    assert common_scale([zero - 0.03, zero]) == pytest.approx(0.05)


def test_color_bars_match_the_map() -> None:
    bar = color_bar("local", "", 0.2, "%", "", 100)
    assert bar["ticks"] == ["0", "5", "10", "15", "20"]
    assert color_bar("signed", "", 0.5, "", "")["ticks"] == ["−0.5", "−0.25", "0", "0.25", "0.5"]
    first, last = palette("local")[0], palette("local")[-1]
    text = bar["gradient"]
    assert text.startswith("linear-gradient(90deg, rgb({} {} {}),".format(*first))
    assert text.endswith("rgb({} {} {}))".format(*last))

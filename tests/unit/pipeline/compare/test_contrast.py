"""Contrast of luminance and chroma: closed forms, noise, error bars."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mbtf_core.images.read import LUMINANCE
from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.contrast import contrast, picture_blocks

SIZE = 128
# Mean color, and a color of luminance 0.
MEAN = np.array([0.3, 0.5, 0.2])
OPPONENT = np.array([LUMINANCE[2], 0.0, -LUMINANCE[0]])


def picture(light: float, color: float, phase: float = 0.0) -> NDArray[np.float64]:
    """Waves of luminance along columns and of chroma along rows, (n, 3)."""
    y, x = np.meshgrid(*(2 * np.pi * 8 * np.arange(SIZE) / SIZE,) * 2, indexing="ij")
    wave = 1 + light * np.sin(x)[..., None]
    return np.asarray((wave * MEAN + color * np.sin(y + phase)[..., None] * OPPONENT).reshape(-1, 3))


def halves(truth: NDArray[np.float64], noise: float, seed: int = 0) -> list[NDArray[np.float64]]:
    random = np.random.default_rng(seed)
    return [truth + noise * random.standard_normal(truth.shape) for _ in range(2)]


def of(values: NDArray[np.float64], reference: list[NDArray[np.float64]]) -> dict[str, Any]:
    return contrast(values, *reference, picture_blocks(SIZE, SIZE))


def test_shares_of_the_contrast_are_found_beside_noise() -> None:
    """60 % of the chroma and 90 % of the luminance, with noise as large as the waves."""
    found = of(picture(0.27, 0.6), halves(picture(0.3, 1.0), 0.1))
    for name, wanted in {"luminance": 0.9, "chroma": 0.6, "correlation": 1.0}.items():
        assert found[name].value == pytest.approx(wanted, abs=4 * found[name].error)
        assert found[name].error < 0.02


@pytest.mark.parametrize("phase", [0.0, 1.0, 2.5])
def test_moved_chroma_has_the_cosine_of_its_phase_as_correlation(phase: float) -> None:
    found = of(picture(0.3, 1.0, phase), halves(picture(0.3, 1.0), 0.0))
    assert found["correlation"].value == pytest.approx(np.cos(phase), abs=1e-6)
    assert found["chroma"].value == pytest.approx(1.0, abs=1e-6)


def test_a_gray_reference_has_no_chroma() -> None:
    """Neither has one of a single hue, whose color follows its luminance, nor one whose color is noise."""
    found = of(picture(0.3, 1.0), halves(picture(0.3, 0.0), 0.05))
    assert found["chroma"] is None
    assert found["correlation"] is None
    assert found["luminance"].value == pytest.approx(1.0, abs=4 * found["luminance"].error)
    # 0.02 · |OPPONENT| is 3.4 % of 0.3 times the mean luminance; 0.04 is 6.9 %.
    assert of(picture(0.3, 1.0), halves(picture(0.3, 0.02), 0.0))["chroma"] is None
    assert of(picture(0.3, 1.0), halves(picture(0.3, 0.04), 0.0))["chroma"] is not None


def test_error_bars_cover_the_truth() -> None:
    """Noise of a fit in blocks of 8 pixels: bars over single pixels would be eight times too small."""
    deviations = []
    for seed in range(40):
        random = np.random.default_rng(seed)
        coarse = random.standard_normal((SIZE // 8, SIZE // 8)).repeat(8, 0).repeat(8, 1)
        values = picture(0.3, 0.0) * (1 + 0.2 * coarse.reshape(-1, 1))
        one = of(values, halves(picture(0.3, 0.0), 0.1, 100 + seed))["luminance"]
        # var = m² (0.3²/2 + 0.2² (1 + 0.3²/2)), without the variance of the coarse noise's mean.
        truth = np.sqrt((0.045 + 0.04 * 1.045) / 0.045)
        deviations.append((one.value - truth) / one.error)
    assert 0.6 < np.std(deviations) < 1.5
    assert abs(np.mean(deviations)) < 0.7


def test_estimates_have_as_many_units_as_blocks() -> None:
    one = of(picture(0.3, 1.0), halves(picture(0.3, 1.0), 0.1))["luminance"]
    assert isinstance(one, Estimate)
    assert one.n == 64

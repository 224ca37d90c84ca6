"""Errors of pictures are free of the reference's noise and keep their scale."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mbtf_pipeline.compare.metrics import halves_score, score, white_point


def noisy(truth: np.ndarray, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    a, b = (truth + noise * random.standard_normal(truth.shape) for _ in range(2))
    return a, b


def test_error_without_the_reference_s_noise() -> None:
    truth = np.random.default_rng(1).random((96, 96, 3)) + 0.5
    a, b = noisy(truth, 0.3, 2)
    result = score(truth + 0.1, a, b)
    assert abs(result.mse.value - 0.01) < 4 * result.mse.error
    assert result.mse.error < 0.002
    # The plain error against the mean of the halves would be 0.01 + 0.3²/2.
    assert np.mean((truth + 0.1 - (a + b) / 2) ** 2) > 0.05


def test_psnr_of_a_known_error() -> None:
    truth = np.full((16, 16, 3), 0.4)
    result = score(truth + 0.02, truth, truth)
    assert result.psnr(2.0)[0] == pytest.approx(40.0)
    assert score(truth, truth, truth).psnr(1.0) == (math.inf, math.inf)
    assert score(truth, truth, truth).as_dict(1.0)["psnr"] == {"value": None, "error": None, "n": 256}


def test_relative_error_does_not_depend_on_the_unit() -> None:
    truth = np.random.default_rng(3).random((32, 32, 3)) ** 4
    picture = 1.1 * truth
    values = [score(s * picture, s * truth, s * truth).relative_mse.value for s in (1.0, 1e-6, 1e5)]
    assert values == pytest.approx([values[0]] * 3)
    assert 0 < values[0] < 0.01


def test_a_black_reference_has_no_relative_error() -> None:
    black = np.zeros((4, 4, 3))
    result = score(black + 1.0, black, black)
    assert result.mse.value == 1.0
    assert math.isnan(result.relative_mse.value)
    assert result.as_dict(1.0)["relative_mse"]["value"] is None


def test_two_references_of_one_truth_agree() -> None:
    truth = np.random.default_rng(4).random((64, 64, 3))
    first, second = noisy(truth, 0.2, 5), noisy(truth, 0.2, 6)
    same = halves_score(first, *second)
    assert abs(same.value) < 4 * same.error
    shifted = halves_score((first[0] + 0.1, first[1] + 0.1), *second)
    assert shifted.value > 4 * shifted.error


def test_white_point() -> None:
    ramp = np.linspace(0, 1, 2001)[:, None, None] * np.ones(3)
    assert white_point([ramp]) == pytest.approx(0.95 / 0.8)
    assert white_point([ramp, 100 * ramp, 3 * ramp]) == pytest.approx(3 * 0.95 / 0.8)
    assert white_point([0 * ramp]) == 1.0

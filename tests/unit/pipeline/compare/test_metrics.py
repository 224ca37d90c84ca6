"""Errors of images are noise-free and scale correctly."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mbtf_pipeline.compare.metrics import image_errors, reference_difference


def noisy(truth: np.ndarray, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    a, b = (truth + noise * random.standard_normal(truth.shape) for _ in range(2))
    return a, b


def test_noise_of_the_reference_does_not_bias_the_error() -> None:
    truth = np.random.default_rng(1).random((96, 96, 3)) + 0.5
    a, b = noisy(truth, 0.3, 2)
    mse = image_errors(truth + 0.1, a, b, 1.0)["mse"]
    assert abs(mse.value - 0.01) < 4 * mse.error
    assert mse.error < 0.002
    # The plain error against the mean of the halves would be 0.01 + 0.3²/2.
    assert np.mean((truth + 0.1 - (a + b) / 2) ** 2) > 0.05


def test_noise_of_the_reference_hardly_biases_the_relative_error() -> None:
    """Only the denominator includes it; the square of one half's difference would be twice as large."""
    truth = np.ones((96, 96, 3))
    found = image_errors(truth + 0.03, *noisy(truth, 0.03, 7), 1.0)["relative_mse"]
    assert found.value == pytest.approx(0.03**2 / 1.01, rel=0.15)
    assert found.error < 0.03 * found.value


def test_psnr_of_a_known_error() -> None:
    truth = np.full((16, 16, 3), 0.4)
    assert image_errors(truth + 0.02, truth, truth, 2.0)["psnr"].value == pytest.approx(40.0)
    record = image_errors(truth, truth, truth, 1.0)["psnr"].as_dict()
    assert record == {"value": None, "error": None, "n": 256}


def test_relative_error_does_not_depend_on_the_unit() -> None:
    truth = np.random.default_rng(3).random((32, 32, 3)) ** 4
    picture = 1.1 * truth
    found = [image_errors(s * picture, s * truth, s * truth, 1.0) for s in (1.0, 1e-6, 1e5)]
    values = [errors["relative_mse"].value for errors in found]
    assert values == pytest.approx([values[0]] * 3)
    assert 0 < values[0] < 0.01


def test_a_black_reference_has_no_relative_error() -> None:
    black = np.zeros((4, 4, 3))
    errors = image_errors(black + 1.0, black, black, 1.0)
    assert errors["mse"].value == 1.0
    assert math.isnan(errors["relative_mse"].value)


def test_two_references_of_one_truth_agree() -> None:
    truth = np.random.default_rng(4).random((64, 64, 3))
    first, second = noisy(truth, 0.2, 5), noisy(truth, 0.2, 6)
    same = reference_difference(first, *second)
    assert abs(same.value) < 4 * same.error
    shifted = reference_difference((first[0] + 0.1, first[1] + 0.1), *second)
    assert shifted.value > 4 * shifted.error

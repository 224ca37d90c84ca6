"""Blur of textures and its annealing."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from mbtf_fit.pytorch.textures import annealed_sigma, blur_texture


@pytest.mark.parametrize(
    ("rows", "columns", "sigma"),
    [(1, 8, 2.0), (3, 4, 1.7), (5, 6, 9.0), (2, 2, 0.5), (128, 64, 8.0), (64, 96, 0.4), (32, 1, 1.0)],
)
def test_blur_equals_scipys_wrapped_gaussian(rows: int, columns: int, sigma: float) -> None:
    texture = torch.randn(rows, columns, 3, dtype=torch.float64)
    expected = texture.numpy()
    for axis in (0, 1):
        expected = gaussian_filter1d(expected, sigma, axis=axis, mode="wrap", radius=math.ceil(3.5 * sigma))
    torch.testing.assert_close(blur_texture(texture, sigma), torch.from_numpy(expected))


def test_gradients_agree_with_finite_differences() -> None:
    texture = torch.randn(4, 32, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: blur_texture(t, 1.3), (texture,), fast_mode=True)


def test_a_negligible_blur_changes_nothing() -> None:
    texture = torch.randn(4, 4, 1)
    assert blur_texture(texture, 0.1) is texture


def test_annealing_ends_with_its_fraction_of_the_budget() -> None:
    sigmas = [annealed_sigma(share, 8.0, 0.25) for share in (0.0, 0.2, 0.5, 0.999, 1.0, 1.5)]
    assert sigmas[0] == 8.0
    assert sigmas[2] == pytest.approx((8.0 * 0.25) ** 0.5)
    assert sigmas == sorted(sigmas, reverse=True)
    assert sigmas[3] == pytest.approx(0.25, rel=0.01)
    assert sigmas[4:] == [0.0, 0.0]
    assert annealed_sigma(0.0, 0.0, 0.25) == 0.0

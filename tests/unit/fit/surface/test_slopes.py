"""Distributions of slopes: known ones, and the likelihood itself."""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import minimize

from mbtf_fit.surface.slopes import slope_distributions


def moments_of(slopes: np.ndarray) -> np.ndarray:
    x, y = np.moveaxis(slopes, -1, 0)
    return np.stack([x * x, x * y, y * y], -1)


def scatter_of(found: np.ndarray) -> np.ndarray:
    """C (..., 3) of centers and moments (..., 5)."""
    return found[..., 2:] - moments_of(found[..., :2])


def test_a_t_distribution_is_recovered() -> None:
    random = np.random.default_rng(0)
    center, scatter = np.array([0.4, -0.2]), np.array([[0.30, 0.10], [0.10, 0.15]])
    root = np.sqrt(random.exponential(size=(128, 128, 1)))
    drawn = center + random.multivariate_normal(np.zeros(2), scatter, size=(128, 128)) / root
    slopes = drawn.astype(np.float32)
    found = slope_distributions(slopes, moments_of(slopes), 1.0, (1, 1), 0.5)[0, 0].numpy()
    np.testing.assert_allclose(found[:2], center, atol=0.03)
    np.testing.assert_allclose(scatter_of(found), [0.30, 0.10, 0.15], atol=0.03)


def test_the_likelihood_of_a_footprint_is_highest() -> None:
    """Of texels by their Gaussian weights, in a tile twice as wide as high; minimized by another program."""
    random = np.random.default_rng(1)
    waves = [np.sin(2 * np.pi * np.arange(n) / n) for n in (16, 32)]
    smooth = np.stack(np.broadcast_arrays(waves[1][None], waves[0][:, None]), -1)
    slopes = (smooth + random.standard_normal((16, 32, 2)) ** 3 * [0.1, 0.05]).astype(np.float32)
    sigma, aspect, at = 0.08, 0.5, (1, 5)
    found = slope_distributions(slopes, moments_of(slopes), aspect, (4, 8), sigma)[at].numpy()
    rows, columns = np.arange(16) - (at[0] + 0.5) * 4 + 0.5, np.arange(32) - (at[1] + 0.5) * 4 + 0.5
    weight = 1.0
    for axis, (offset, size, length) in enumerate(((rows, 16, aspect), (columns, 32, 1.0))):
        distance = ((offset + size / 2) % size - size / 2) * length / size
        inside = np.abs(distance) < 2.6 * sigma
        weight = weight * np.expand_dims(inside * np.exp(-0.5 * (distance / sigma) ** 2), 1 - axis)

    def loss(x: np.ndarray) -> float:
        root = np.array([[np.exp(x[2]), 0], [x[3], np.exp(x[4])]])
        d = np.linalg.solve(root, (slopes - x[:2]).reshape(-1, 2).T)
        logarithm = -2 * np.log1p((d**2).sum(0) / 2) - x[2] - x[4]
        return -float(logarithm @ weight.ravel() / weight.sum())

    best = minimize(loss, [0, 0, -1, 0, -1], method="Nelder-Mead", options={"maxiter": 4000, "xatol": 1e-5})
    root = np.array([[np.exp(best.x[2]), 0], [best.x[3], np.exp(best.x[4])]])
    wanted = (root @ root.T)[[0, 0, 1], [0, 1, 1]]
    np.testing.assert_allclose(found[:2], best.x[:2], atol=0.01)
    np.testing.assert_allclose(scatter_of(found), wanted, rtol=0.05, atol=0.003)


def test_detail_below_a_texel_is_part_of_the_scatter() -> None:
    """Texels of one slope: of these the covariance is the weighted one of t-distributions, C = E[w d dᵀ]."""
    flat = np.zeros((8, 8, 2), np.float32)
    detail = np.broadcast_to(np.array([0.2, 0.05, 0.1], np.float32), (8, 8, 3))
    found = slope_distributions(flat, detail, 1.0, (8, 8), 0.1).numpy()
    np.testing.assert_allclose(found, np.broadcast_to([0, 0, 0.2, 0.05, 0.1], found.shape), atol=1e-6)


def test_the_bits_do_not_depend_on_the_number_of_threads() -> None:
    slopes = np.random.default_rng(3).normal(size=(256, 256, 2)).astype(np.float32)
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            found.append(slope_distributions(slopes, moments_of(slopes), 1.0, (1, 1), 0.18))
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])

"""χ² of samplers: uniform p-values for right ones, faults found for wrong ones, plane and sphere."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats as reference

from mbtf_core.errors import InputError
from mbtf_core.stats import Cap, Rectangle, chi_square_test

Floats = NDArray[np.float64]


def cosine_directions(rng: np.random.Generator, n: int) -> Floats:
    """Directions with density cos θ / π on the upper hemisphere."""
    r, phi = np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    return np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(1 - r * r)], axis=-1)


def cosine_density(w: Floats) -> Floats:
    return np.maximum(w[:, 2], 0.0) / np.pi


def lobe(rng: np.random.Generator, n: int, axis: Floats, degrees: float) -> Floats:
    """von Mises-Fisher directions about an axis, concentration 1/radians(degrees)²."""
    kappa = 1.0 / np.radians(degrees) ** 2
    height = -np.log1p(-rng.random(n) * -np.expm1(-2 * kappa)) / kappa
    frame = Cap((axis[0], axis[1], axis[2]))
    return frame.points(np.stack([height, rng.uniform(-np.pi, np.pi, n)], axis=-1))


def lobe_density(w: Floats, axis: Floats, degrees: float) -> Floats:
    kappa = 1.0 / np.radians(degrees) ** 2
    height = ((w - axis) ** 2).sum(axis=-1) / 2.0
    return kappa / (2 * np.pi * -np.expm1(-2 * kappa)) * np.exp(-kappa * height)


def test_p_values_are_uniform_for_a_right_sampler() -> None:
    rng = np.random.default_rng(1)
    cap = Cap(cos_min=0.0)
    samples = (cosine_directions(rng, 4000) for _ in range(400))
    p = [chi_square_test(w, cosine_density, cap, (6, 10)).p_value for w in samples]
    assert reference.kstest(p, "uniform").pvalue > 1e-3


def test_p_values_are_uniform_with_a_jump_inside_the_cells() -> None:
    """A tilted pole lets the horizon cut through cells; many cells must be pooled."""
    rng = np.random.default_rng(2)
    cap = Cap((1.0, 0.3, 0.2))
    samples = (cosine_directions(rng, 4000) for _ in range(300))
    results = [chi_square_test(w, cosine_density, cap, (8, 12)) for w in samples]
    assert reference.kstest([r.p_value for r in results], "uniform").pvalue > 1e-3
    assert results[0].mass == pytest.approx(1.0, abs=1e-3)


def test_wrong_samplers_are_found() -> None:
    rng = np.random.default_rng(3)
    w = cosine_directions(rng, 100_000)
    uniform = rng.normal(size=(20_000, 3))
    uniform /= np.linalg.norm(uniform, axis=1, keepdims=True)
    uniform[:, 2] = np.abs(uniform[:, 2])
    assert chi_square_test(uniform, cosine_density, Cap(cos_min=0.0)).p_value < 1e-12
    skewed = w * np.array([1.0, 0.95, 1.0])
    skewed /= np.linalg.norm(skewed, axis=1, keepdims=True)
    assert chi_square_test(skewed, cosine_density, Cap(cos_min=0.0), (8, 16)).p_value < 1e-3


def test_a_density_that_is_not_normalized_is_found() -> None:
    w = cosine_directions(np.random.default_rng(4), 20_000)
    for factor in (0.97, 1.03):
        for cap in (Cap(), Cap(cos_min=0.0), Cap((1.0, 0.3, 0.2))):
            assert chi_square_test(w, lambda d, f=factor: f * cosine_density(d), cap).p_value < 1e-3


def test_samples_where_the_density_is_zero_are_found() -> None:
    w = cosine_directions(np.random.default_rng(5), 20_000)
    w[7, 2] *= -1.0
    result = chi_square_test(w, cosine_density, Cap())
    assert result.p_value == 0.0
    assert "1 samples where the density is zero" in result.note


@pytest.mark.parametrize("degrees", [0.05, 1.0, 30.0])
def test_narrow_and_wide_lobes(degrees: float) -> None:
    rng = np.random.default_rng(6)
    axis = np.array([0.6, -0.48, 0.64])
    w = lobe(rng, 50_000, axis, degrees)
    cap = Cap.of_angle(axis, min(180.0, 4.0 * degrees))
    right = chi_square_test(w, lambda d: lobe_density(d, axis, degrees), cap)
    assert right.p_value > 1e-3
    wrong = chi_square_test(w, lambda d: lobe_density(d, axis, 1.05 * degrees), cap)
    assert wrong.p_value < 1e-6
    aside = Cap((axis[0], axis[1], axis[2])).points(np.array([[np.radians(degrees) ** 2 / 200.0, 1.0]]))[0]
    shifted = lobe(rng, 50_000, aside, degrees)
    assert chi_square_test(shifted, lambda d: lobe_density(d, axis, degrees), cap).p_value < 1e-3


def test_single_precision_directions_of_a_narrow_lobe() -> None:
    """Rounding to float32 must not look like a fault of a lobe a twentieth of a degree wide."""
    axis = np.array([0.6, -0.48, 0.64])
    w = lobe(np.random.default_rng(7), 50_000, axis, 0.05).astype(np.float32)
    cap = Cap.of_angle(axis, 0.2)
    assert chi_square_test(w, lambda d: lobe_density(d, axis, 0.05), cap).p_value > 1e-3


def test_plane() -> None:
    rng = np.random.default_rng(8)
    disk = cosine_directions(rng, 50_000)[:, :2]

    def density(x: Floats) -> Floats:
        return ((x**2).sum(axis=1) < 1.0) / np.pi

    square = Rectangle(-1.0, 1.0, -1.0, 1.0)
    assert chi_square_test(disk, density, square).p_value > 1e-3
    assert chi_square_test(disk * 0.98, density, square).p_value < 1e-6
    gauss = rng.normal(size=(50_000, 2))

    def normal(x: Floats) -> Floats:
        return np.exp(-(x**2).sum(axis=1) / 2) / (2 * np.pi)

    inner = chi_square_test(gauss, normal, Rectangle(-2.0, 2.0, -2.0, 2.0))
    assert inner.p_value > 1e-3
    assert inner.outside[1] == pytest.approx(50_000 * (1 - 0.954499736**2), rel=1e-3)
    assert chi_square_test(gauss * 1.04, normal, Rectangle(-2.0, 2.0, -2.0, 2.0)).p_value < 1e-6


def test_bad_calls() -> None:
    points = np.random.default_rng(9).random((100, 2))
    with pytest.raises(InputError, match="1 numbers are NaN"):
        chi_square_test(np.where(points == points[3, 0], np.nan, points), lambda x: np.ones(len(x)))
    with pytest.raises(ValueError, match="negative"):
        chi_square_test(points, lambda x: x[:, 0] - 0.5)
    with pytest.raises(ValueError, match="two cells"):
        chi_square_test(points[:4], lambda x: np.ones(len(x)))

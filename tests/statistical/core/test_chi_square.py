"""χ² of samplers: uniform p-values for right ones, faults found for wrong ones, plane and sphere."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from support.chi_square import Cap, chi_square_test

Floats = NDArray[np.float64]


def lobe(seed: int, axis: Floats, degrees: float) -> Floats:
    """von Mises-Fisher directions about an axis, concentration 1/radians(degrees)²."""
    rng, kappa = np.random.default_rng(seed), 1.0 / np.radians(degrees) ** 2
    height = -np.log1p(-rng.random(50_000) * -np.expm1(-2 * kappa)) / kappa
    return Cap(axis).points(np.stack([height, rng.uniform(-np.pi, np.pi, 50_000)], axis=-1))


def lobe_density(w: Floats, axis: Floats, degrees: float) -> Floats:
    kappa = 1.0 / np.radians(degrees) ** 2
    height = ((w - axis) ** 2).sum(axis=-1) / 2.0
    return kappa / (2 * np.pi * -np.expm1(-2 * kappa)) * np.exp(-kappa * height)


@pytest.mark.parametrize("degrees", [0.05, 1.0, 30.0])
def test_narrow_and_wide_lobes(degrees: float) -> None:
    axis = np.array([0.6, -0.48, 0.64])
    w, cap = lobe(6, axis, degrees), Cap.of_angle(axis, min(180.0, 4.0 * degrees))
    # Rounding to single precision must not look like a fault.
    for right in (w, w.astype(np.float32)):
        assert chi_square_test(right, lambda d: lobe_density(d, axis, degrees), cap).p_value > 1e-3
    assert chi_square_test(w, lambda d: lobe_density(d, axis, 1.05 * degrees), cap).p_value < 1e-6
    aside = Cap(axis).points(np.array([[np.radians(degrees) ** 2 / 200.0, 1.0]]))[0]
    shifted = lobe(7, aside, degrees)
    assert chi_square_test(shifted, lambda d: lobe_density(d, axis, degrees), cap).p_value < 1e-3

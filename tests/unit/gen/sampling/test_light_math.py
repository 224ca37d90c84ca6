"""The light kernel's numbers against integrals worked out another way."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import i0e

from mbtf_core.directions import from_angles
from mbtf_gen.sampling.light_kernel import LightKernel, concentration, lobe_irradiance

WIDTHS = [0.05, 1.0, 5.0, 30.0, 45.0]
ELEVATIONS = [0.0, 0.01, 0.5, 2.0, 20.0, 60.0, 90.0]


def irradiance(kappa: float, elevation: float) -> float:
    """∫ p(ω) max(ω_z, 0) dω in polar coordinates about the plane's normal, where the integral over the
    azimuth is a Bessel function."""
    s, c = np.sin(np.radians(elevation)), np.cos(np.radians(elevation))

    def integrand(beta: float) -> float:
        # β is the elevation of ω; κ(cos of the angle to the axis - 1), split so that nothing overflows.
        z, r = np.sin(beta), np.cos(beta)
        exponent = -2.0 * kappa * np.sin(0.5 * (beta - np.radians(elevation))) ** 2
        return float(z * r * i0e(kappa * r * c) * np.exp(exponent))

    spread = 10.0 / np.sqrt(kappa)
    low, high = np.arcsin(s) - spread, np.arcsin(s) + spread
    ends = np.clip([0.0, low, np.arcsin(s), high, np.pi / 2], 0.0, np.pi / 2)
    total = sum(
        quad(integrand, a, b, epsabs=0, epsrel=1e-11, limit=200)[0] for a, b in pairwise(ends) if b > a
    )
    return float(kappa / -np.expm1(-2 * kappa) * total)


@pytest.mark.parametrize("width", WIDTHS)
def test_irradiance_of_the_lobe(width: float) -> None:
    kappa = concentration(width)
    ours = lobe_irradiance(kappa, np.radians(ELEVATIONS))
    np.testing.assert_allclose(ours, [irradiance(kappa, e) for e in ELEVATIONS], rtol=1e-6)


@pytest.mark.parametrize("width", WIDTHS)
def test_the_table_is_as_good_as_the_integral(width: float) -> None:
    light = LightKernel(width)
    elevation = np.concatenate([np.random.default_rng(0).uniform(0, 90, 300), np.geomspace(1e-4, 10, 100)])
    direct = lobe_irradiance(light.kappa, np.radians(elevation))
    np.testing.assert_allclose(light.irradiance(from_angles(elevation, 30.0)), direct, rtol=1e-6)


def test_radiance_is_cut_below_the_horizon_and_normalized() -> None:
    light = LightKernel(5.0)
    axis = from_angles(1.0, 0.0)
    omega = from_angles([[3.0], [-3.0]], [[0.0, 4.0]])
    radiance = light.radiance(omega, axis)
    assert (radiance[1] == 0).all()
    peak = light.kappa / (2 * np.pi) / light.irradiance(axis)
    np.testing.assert_allclose(radiance[0], peak * np.exp(light.kappa * (omega[0] @ axis - 1.0)))


def test_a_delta_light_is_divided_by_its_cosine() -> None:
    light = LightKernel(0.0)
    assert light.is_delta
    omega = from_angles([90.0, 30.0, 0.01], 10.0)
    np.testing.assert_array_equal(light.irradiance(omega), omega[:, 2])

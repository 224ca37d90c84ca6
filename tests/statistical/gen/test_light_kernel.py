"""The light: unit irradiance at every elevation, and samples that follow the stated density."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from support.chi_square import Cap, Rectangle, chi_square_test
from support.scenes import direction, mi

from mbtf_gen.render.directional_light import DirectionalLight
from mbtf_gen.sampling.light_kernel import LightKernel, concentration, rms_angle_deg

WIDTHS = [0.05, 0.3, 1.0, 5.0, 15.0, 30.0]
ELEVATIONS = [1e-4, 0.01, 0.1, 0.5, 1.0, 3.0, 10.0, 30.0, 60.0, 89.9]


def directional_light(width: float, elevation: float, lanes: int = 1) -> DirectionalLight:
    """Light of many equal lanes, as the renderer makes it."""
    return DirectionalLight.of(LightKernel(width), np.tile(direction(elevation, 0), (lanes, 1)))


def polar_grid(width: float, elevation: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions and solid-angle weights about ω_i; the cut at the horizon is integrated to 1e-5."""
    end = min(np.pi, 9.0 * np.radians(width))
    theta = (np.arange(600) + 0.5) / 600 * end
    phi = (np.arange(400) + 0.5) / 400 * 2 * np.pi
    t, p = np.meshgrid(theta, phi, indexing="ij")
    weight = np.sin(t) * (end / 600) * (2 * np.pi / 400)
    e = np.radians(elevation)
    axis, up = np.array([np.cos(e), 0, np.sin(e)]), np.array([-np.sin(e), 0, np.cos(e)])
    side = np.array([0, 1.0, 0])
    omega = (
        np.cos(t)[..., None] * axis
        + (np.sin(t) * np.cos(p))[..., None] * up
        + (np.sin(t) * np.sin(p))[..., None] * side
    )
    return omega.reshape(-1, 3), weight.ravel()


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("elevation", ELEVATIONS)
def test_irradiance_is_one(width: float, elevation: float) -> None:
    omega, weight = polar_grid(width, elevation)
    light = directional_light(width, elevation)
    above = omega[:, 2] > 0
    radiance = np.array(light.radiance(mi.Vector3f(omega.T.astype(np.float32).copy())), np.float64)
    irradiance = np.sum((weight * radiance * omega[:, 2])[above])
    assert abs(irradiance - 1.0) < 1e-4


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("elevation", [1e-4, 0.5, 10.0, 60.0])
def test_sampled_irradiance_is_one(width: float, elevation: float) -> None:
    """From samples and their density alone: E[L ω_z / q] = 1."""
    n = 1 << 19
    light = directional_light(width, elevation, n)
    rng = np.random.default_rng(7)
    omega = light.sample(mi.Point2f(rng.random((2, n)).astype(np.float32)))
    x = np.array(light.radiance(omega) * omega.z / light.sampling_density(omega), np.float64)
    assert np.all(np.array(omega.z) >= 0)
    assert abs(x.mean() - 1.0) < 5.0 * x.std() / np.sqrt(n) + 1e-4


def reflected_density(
    omega: NDArray[np.float64], width: float, axis: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Lobe plus its reflection at the horizon, from the definition, in double precision."""
    kappa = concentration(width)
    norm = kappa / (2 * np.pi * -np.expm1(-2 * kappa))
    lobes = [np.exp(-0.5 * kappa * np.sum((omega - a) ** 2, axis=-1)) for a in (axis, axis * [1, 1, -1])]
    # Samples on the horizon may be rounded to either side of it.
    return np.where(omega[..., 2] > -1e-5, norm * (lobes[0] + lobes[1]), 0.0)


def sampled(
    width: float, elevation: float, n: int = 200_000
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(samples (n, 3), axis of the lobe)."""
    rng = np.random.default_rng(11)
    xi = mi.Point2f(rng.random((2, n)).astype(np.float32))
    return np.array(directional_light(width, elevation, n).sample(xi), np.float64).T, direction(elevation, 0)


@pytest.mark.parametrize(("width", "elevation"), [(0.05, 60.0), (1.0, 30.0), (30.0, 80.0)])
def test_sampler_follows_its_density(width: float, elevation: float) -> None:
    omega, axis = sampled(width, elevation)
    # A wide lobe fills the hemisphere, whose edge is the horizon.
    domain = Cap.of_angle(axis, 8.0 * width) if width < 10 else Cap.of_angle((0.0, 0.0, 1.0), 90.0)
    result = chi_square_test(omega, lambda w: reflected_density(w, width, axis), domain)
    assert result.p_value > 1e-3, str(result)


@pytest.mark.parametrize(("width", "elevation"), [(0.05, 0.02), (1.0, 1.0), (1.0, 0.0), (5.0, 8.0)])
def test_sampler_follows_its_density_at_the_horizon(width: float, elevation: float) -> None:
    """In the plane (y, z) across the lobe, where the cut at z = 0 is an edge of the domain."""
    omega, axis = sampled(width, elevation)
    reach = np.sin(np.radians(8.0 * width))
    domain = Rectangle(-reach, reach, 0.0, np.sin(np.radians(elevation + 8.0 * width)))

    def density(yz: NDArray[np.float64]) -> NDArray[np.float64]:
        x = np.sqrt(np.maximum(1e-12, 1 - yz[:, 0] ** 2 - yz[:, 1] ** 2))
        return reflected_density(np.column_stack([x, yz]), width, axis) / x

    result = chi_square_test(omega[:, 1:], density, domain)
    assert result.p_value > 1e-3, str(result)


@pytest.mark.parametrize("width", WIDTHS)
def test_width_is_the_rms_angle_per_axis(width: float) -> None:
    kappa = concentration(width)
    assert rms_angle_deg(kappa) == pytest.approx(width, rel=1e-9)
    # Independent: moments of a million sampled polar angles.
    rng = np.random.default_rng(5)
    versine = -np.log1p(-rng.random(1_000_000) * -np.expm1(-2 * kappa)) / kappa
    theta = 2 * np.arcsin(np.sqrt(versine / 2))
    assert np.degrees(np.sqrt(np.mean(theta**2) / 2)) == pytest.approx(width, rel=5e-3)

"""Extreme cases: planes, M = albedo/π for every query; footprints far below a texel and far beyond a tile."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.closed_forms import Groove
from support.scenes import DIRECT, HeightGrid, LightKernel, direction, estimate, lambert, queries
from support.surfaces import towards

from mbtf_core.stats import mean_estimate, mean_of_halves, t_test

SHAPES = [(1, 1), (1, 7), (5, 1), (3, 5), (16, 4), (31, 17)]
WIDTHS = [0.0, 0.01, 1.0, 45.0]
# Decimal logarithms, but for heights.
COSINES, SIGMAS, ALBEDOS = st.floats(-4.0, 0.0), st.floats(-9.0, 3.0), st.floats(-8.0, 0.0)
HEIGHTS = st.floats(-1e3, 1e3)
Shape = tuple[int, int]


@settings(max_examples=30)
@example(0.0, -4.0, -4.0, -9.0, (1, 1), 0.5, -8.0)
@example(45.0, -4.0, 0.0, 3.0, (1, 7), 0.5, 0.0)
@example(1.0, 0.0, 0.0, -1.0, (1, 1), 0.0, -3.0)
@example(45.0, 0.0, 0.0, -1.0, (1, 1), 0.0, -2.0)
@example(45.0, 0.0, 0.0, -1.0, (1, 1), 0.0, -8.0)
@given(st.sampled_from(WIDTHS), COSINES, COSINES, SIGMAS, st.sampled_from(SHAPES), HEIGHTS, ALBEDOS)
def test_lambert_is_albedo_over_pi_everywhere(
    width: float, light: float, view: float, footprint: float, shape: Shape, height: float, albedo: float
) -> None:
    """Cosines 1e-4 … 1, σ 1e-9 … 1000 tiles, positions on seams and outside the tile, constant maps of any
    height and shape, albedo 1e-8 … 1. 3e-6 without noise; 1e-4 and five standard errors with it."""
    n = 400
    rng = np.random.default_rng(1)
    azimuth = rng.uniform(0, 360, (2, n))
    u = rng.uniform(-2, 3, (n, 2))
    u[: n // 2] = np.round(u[: n // 2])
    q = queries(u, 10.0**footprint, towards(10.0**light, azimuth[0]), towards(10.0**view, azimuth[1]), n)
    grid = HeightGrid.from_map(np.full(shape, height), 1.0)
    assert grid.displacement_range == 0
    e = estimate(grid, lambert(10.0**albedo), LightKernel(width), q, 32)
    assert (e.lost, e.nonfinite) == (0, 0)
    # Light from 1e-7 above the horizon crosses thousands of tiles; it brings next to nothing.
    assert e.capped <= (1e-3 * e.paths if width else 0)
    ratio = np.stack([e.value_a, e.value_b]).astype(np.float64)[..., 0] * np.pi / 10.0**albedo
    if width == 0:
        np.testing.assert_allclose(ratio, 1.0, rtol=3e-6)
    else:
        mean = mean_of_halves(ratio[0], ratio[1])
        assert mean.error < 0.03
        assert abs(mean.value - 1.0) < 1e-4 + 5 * mean.error


GROOVE = Groove(0.4, 0.7)
ELEVATIONS = st.floats(8.0, 90.0)
AZIMUTHS = st.floats(0.0, 360.0)


@settings(max_examples=20)
@given(ELEVATIONS, AZIMUTHS, ELEVATIONS, AZIMUTHS, st.sampled_from([0.0, 1e-12, 1e-6]))
def test_a_vanishing_footprint_is_a_point(
    elevation_i: float, azimuth_i: float, elevation_o: float, azimuth_o: float, sigma: float
) -> None:
    """B in closed form within 2e-5, at points at least 1e-4 away from edges of shadow and visibility."""
    omega_i, omega_o = direction(elevation_i, azimuth_i), direction(elevation_o, azimuth_o)
    n = 500
    x = (np.arange(n) + 0.37) / n
    q = queries(np.column_stack([x, x[::-1]]), sigma, omega_i, omega_o, n)
    e = estimate(GROOVE.grid, lambert(0.7), LightKernel(0.0), q, 2, transport=DIRECT)
    near = np.stack([GROOVE.value(x + d, omega_i, omega_o) for d in (-1e-4, 0.0, 1e-4)])
    clear = np.all(near == near[0], axis=0)
    assert clear.mean() > 0.98
    np.testing.assert_allclose(e.value_a[clear, 0], near[0][clear], rtol=2e-5, atol=1e-7)
    np.testing.assert_allclose(e.value_b[clear, 0], near[0][clear], rtol=2e-5, atol=1e-7)


@pytest.mark.parametrize("sigma", [2.0, 10.0, 1e3])
def test_a_huge_footprint_is_the_tile_mean(sigma: float) -> None:
    """The closed form of the tile mean at every position, by t-test with an error bar below 0.5%."""
    omega_i, omega_o = direction(35, 10), direction(50, 200)
    expected = GROOVE.tile_mean(omega_i, omega_o)
    for u in ([0.25, 0.0], [0.75, 0.5]):
        q = queries(u, sigma, omega_i, omega_o, 8000)
        e = estimate(GROOVE.grid, lambert(0.7), LightKernel(0.0), q, 32, transport=DIRECT)
        mean = mean_estimate(0.5 * (e.value_a + e.value_b)[:, 0])
        assert mean.relative_error < 5e-3
        assert t_test(mean, expected).p_value > 1e-4

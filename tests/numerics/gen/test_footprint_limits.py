"""Footprints at their limits: σ → 0 is the BTF at a point, σ far beyond a tile is the tile mean."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.closed_forms import Groove
from support.scenes import DIRECT, LightKernel, direction, estimate, lambert, queries

from mbtf_core.stats import mean_estimate, t_test

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

"""A plane in extreme cases: M = albedo/π for every light, view, footprint, position and map size."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.scenes import HeightGrid, LightKernel, estimate, lambert, queries
from support.surfaces import towards

from mbtf_core.stats import mean_of_halves

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

"""Steep, high and tiny height fields and maps of odd shapes: white furnace, black, and reciprocity."""

from __future__ import annotations

import numpy as np
import pytest
from support.closed_forms import Wall
from support.scenes import (
    DIRECT,
    HeightGrid,
    LightKernel,
    direction,
    estimate,
    lambert,
    queries,
    rocks,
    tile_mean_queries,
)
from support.surfaces import towards

from mbtf_core.stats import Estimate, mean_estimate, mean_of_halves, t_test


def binary(rows: int, columns: int, slope: float, seed: int = 0) -> HeightGrid:
    """Random blocks, a third of them high, flanks one cell wide of the given slope."""
    high = np.random.default_rng(seed).random((rows, columns)) < 1 / 3
    return HeightGrid.from_map(high.astype(np.float64), slope / columns)


def needle(resolution: int, slope: float) -> HeightGrid:
    """One high texel."""
    height = np.zeros((resolution, resolution))
    height[1, 2] = 1.0
    return HeightGrid.from_map(height, slope / resolution)


RELIEFS = {
    "blocks of slope 100": binary(32, 32, 100.0),
    "needle of slope 100": needle(64, 100.0),
    "ten tiles high": rocks(32, 10.0),
    "1e-6 high": rocks(32, 1e-6),
    "31 by 17": binary(31, 17, 5.0),
    "1 by 7": binary(1, 7, 2.0, seed=3),
    "2 by 1": HeightGrid.from_map(np.array([[0.0], [1.0]]), 0.3),
}


@pytest.fixture(params=RELIEFS, ids=lambda name: name.replace(" ", "-"))
def relief(request: pytest.FixtureRequest) -> HeightGrid:
    return RELIEFS[request.param]


@pytest.mark.parametrize("cosine", [1.0, 0.2, 1e-4])
def test_white_furnace_returns_one(relief: HeightGrid, cosine: float) -> None:
    """No energy is created, within 1e-3 and five standard errors; none is lost where paths can escape."""
    # Slots a hundred times deeper than wide hold paths for thousands of bounces, which ever fewer of ever
    # greater weight survive: no error bar holds then.
    trapped = relief.displacement_range > 3
    n = 300 if trapped else 3000
    e = estimate(relief, lambert(1.0), None, tile_mean_queries([0, 0, 1], towards(cosine, 33.0), n), 16)
    mean = mean_of_halves(e.value_a[:, 0], e.value_b[:, 0])
    assert mean.value < 1.0 + 1e-3 + 5 * mean.error
    if not trapped:
        assert mean.error < 2e-3
        assert mean.value > 1.0 - 1e-3 - 5 * mean.error
    # Creases of steep flanks swallow a ray in 10⁵.
    assert e.lost <= max(3, 1e-4 * e.paths)
    assert e.nonfinite == 0


@pytest.mark.parametrize(
    "light", [LightKernel(0.0), LightKernel(5.0), None], ids=["delta", "lobe", "furnace"]
)
def test_black_is_exactly_black(relief: HeightGrid, light: LightKernel | None) -> None:
    e = estimate(relief, lambert(0.0), light, tile_mean_queries(direction(20, 5), direction(40, 80), 500), 4)
    assert np.all(e.value_a == 0)
    assert np.all(e.value_b == 0)


def test_tile_mean_is_reciprocal(relief: HeightGrid) -> None:
    """Light and view exchanged, interreflection included: t-test, error bars below 2%."""
    one, other = direction(35, 25), direction(60, 250)

    def mean(omega_i: object, omega_o: object, seed: int) -> Estimate:
        q = tile_mean_queries(omega_i, omega_o, 8000, seed)  # type: ignore[arg-type]
        e = estimate(relief, lambert(0.8), LightKernel(0.0), q, 16, seed=seed)
        found = mean_estimate(0.5 * (e.value_a + e.value_b)[:, 0])
        # A plane, or nearly one, has no variance but rounding.
        return Estimate(found.value, float(np.hypot(found.error, 3e-6)), found.n)

    forward, backward = mean(one, other, 1), mean(other, one, 2)
    assert max(forward.relative_error, backward.relative_error) < 0.02
    assert t_test(forward, backward).p_value > 1e-4


def test_grazing_light_and_view_stay_finite(relief: HeightGrid) -> None:
    """Cosines down to 1e-4 on both sides: in [0, a few times albedo/π over the cosine of the light]."""
    n = 600
    rng = np.random.default_rng(6)
    cosine = 10 ** rng.uniform(-4, 0, (2, n))
    azimuth = rng.uniform(0, 360, (2, n))
    q = queries(rng.random((n, 2)), 0.05, towards(cosine[0], azimuth[0]), towards(cosine[1], azimuth[1]), n)
    for width in (0.0, 1.0):
        light = LightKernel(width)
        e = estimate(relief, lambert(0.8), light, q, 16)
        brightest = 0.8 / np.pi / light.irradiance(q.omega_i.astype(np.float64))
        for values in (e.value_a, e.value_b):
            assert np.all(np.isfinite(values))
            assert np.all(values >= 0)
            assert np.all(values[:, 0] < 5 * brightest + 1)
        assert e.nonfinite == 0
        assert e.lost <= 1e-3 * e.paths


def test_a_tiny_displacement_is_a_plane() -> None:
    """Heights of 1e-6 tile widths, displaced: albedo/π within the slopes, 1e-4."""
    n = 500
    q = queries(np.random.default_rng(0).random((n, 2)), 0.01, direction(60, 20), direction(70, 100), n)
    e = estimate(RELIEFS["1e-6 high"], lambert(0.5), LightKernel(0.0), q, 8)
    np.testing.assert_allclose(e.value_a, 0.5 / np.pi, rtol=1e-4)
    assert e.lost == 0


@pytest.mark.parametrize("elevation", [70.0, 75.0, 88.0])
@pytest.mark.parametrize("azimuth", [0.0, 180.0])
@pytest.mark.parametrize("columns", [64, 47])
def test_shadow_and_flank_of_a_wall_of_slope_100(elevation: float, azimuth: float, columns: int) -> None:
    """Closed form seen from above: lit floor, shadow, and a flank that catches the grazing rays."""
    wall = Wall(columns, 100.0, 0.7)
    light = direction(elevation, azimuth)
    q = tile_mean_queries(light, direction(90, 0), 60_000)
    e = estimate(wall.grid, lambert(0.7), LightKernel(0.0), q, 16, transport=DIRECT)
    mean = mean_estimate(0.5 * (e.value_a + e.value_b)[:, 0])
    expected = wall.tile_mean_from_above(light)
    assert mean.relative_error < 3e-3
    assert abs(mean.value / expected - 1) < 1e-3 + 4.5 * mean.relative_error

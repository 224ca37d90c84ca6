"""Triangles traced by Mitsuba give the values of the height field; so do shifted periods."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.mitsuba_blocks import SPP, random_queries
from support.scenes import (
    LightKernel,
    build_tile,
    direction,
    estimate,
    lambert,
    mi,
    real_heights,
    rocks,
    tile_mean_queries,
)

from mbtf_core.stats import aggregate_test, elevation_groups
from mbtf_gen.geometry.heightfield import HeightGrid

WHITE = lambert(1.0)
SURFACES: dict[str, dict[str, Any]] = {
    "diffuse": lambert(0.7),
    "glossy": {"type": "roughconductor", "alpha": 0.2},
    "holes": {"type": "mbtf_surface", "base_color": 0.7, "opacity": 0.7},
}


@pytest.mark.parametrize("name", SURFACES)
def test_both_tracers_give_the_same_values(name: str) -> None:
    """With shadows and interreflection, on rock."""
    grid, bsdf = real_heights("cliff_rock"), SURFACES[name]
    q = random_queries(4096, 0.02)
    kernel = LightKernel(3.0)
    one, two = (
        estimate(grid, bsdf, kernel, q, SPP, seed=seed, tracer=tracer)
        for seed, tracer in ((1, "heightfield"), (2, "mesh"))
    )
    assert two.lost == two.capped == 0 or name == "holes"
    groups = elevation_groups(q.omega_o, edges=(0.0, 0.5, 1.0))
    result = aggregate_test(one.value_a, one.value_b, two.value_a, two.value_b, groups)
    assert result.p_value > 1e-3, str(result)
    if name == "holes":
        assert one.transmittance is not None
        assert two.transmittance is not None
        gap = one.transmittance - two.transmittance
        assert 0.05 < one.transmittance.mean() < 0.5
        assert abs(gap.mean()) < 4 * gap.std() / len(gap) ** 0.5


def test_a_white_mesh_returns_all_light() -> None:
    q = tile_mean_queries([0, 0, 1], direction(30, 20), 2000)
    e = estimate(rocks(), WHITE, None, q, 16, tracer="mesh")
    assert e.lost == e.capped == 0
    mean = 0.5 * (e.value_a + e.value_b).mean(axis=1)
    error = float(mean.std()) / len(mean) ** 0.5
    assert float(mean.mean()) == pytest.approx(1.0, abs=4 * error + 1e-6)


def test_shifts_by_periods_change_nothing() -> None:
    """Hits of rays whose origins lie in other periods."""
    grid = HeightGrid(rocks().z, 0.5)
    tile = build_tile(grid, lambert(0.5), "mesh")
    rng = np.random.default_rng(0)
    n = 20_000
    o = np.column_stack([(rng.random((n, 2)) - 0.5) * (tile.unit, 0.5 * tile.unit), np.full(n, 0.1)])
    d = rng.normal(size=(n, 3)) * (1.0, 1.0, 0.3)
    d[:, 2] = -np.abs(d[:, 2]) - 0.05
    d /= np.linalg.norm(d, axis=1)[:, None]

    def hits(shift: tuple[int, int]) -> Any:
        moved = o + np.array([shift[0] * tile.unit, 0.5 * shift[1] * tile.unit, 0.0])
        origin, toward = (np.ascontiguousarray(a.T, np.float32) for a in (moved, d))
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(toward))
        return np.array(tile.geometry.closest_hit(ray, mi.Bool(True), 100)[0].p)

    here = hits((0, 0))
    for shift in ((1, 0), (-2, 1), (0, -3)):
        gap = np.abs(hits(shift) - here).max(axis=0) / tile.unit
        # Origins far away are rounded more coarsely; over rims rounding decides.
        assert np.mean(gap > 1e-5) < 1e-3

"""Triangles traced by Mitsuba give the values of the height field."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from support.mitsuba_blocks import SPP, random_queries
from support.scenes import (
    LightKernel,
    build_scene,
    estimate,
    lambert,
    mi,
    real_heights,
)
from support.significance import aggregate_test

from mbtf_core.errors import InputError
from mbtf_core.stats import elevation_groups
from mbtf_gen.tile.heights import HeightGrid, Tracer
from mbtf_gen.tile.tracers.protocol import Vertex

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
        gap = one.transmittance - two.transmittance
        assert 0.05 < one.transmittance.mean() < 0.5
        assert abs(gap.mean()) < 4 * gap.std() / len(gap) ** 0.5


def test_rays_that_leave_points_on_the_border_do_not_meet_their_own_triangle() -> None:
    """The border runs through the outermost vertices, where texel centers lie."""
    z = np.full((16, 16), -0.02)
    z[4, 4] = 0.0
    rng = np.random.default_rng(0)
    n = 20_000
    phi, sine = 2.0 * np.pi * rng.random(n), np.sqrt(rng.random(n))
    d = np.stack([sine * np.cos(phi), sine * np.sin(phi), np.sqrt(1.0 - sine**2)])
    found = []
    for tracer in ("heightfield", "mesh"):
        tile = build_scene(replace(HeightGrid(z, 1.0), tracer=cast(Tracer, tracer)), lambert(0.5))
        edge = 0.5 * tile.unit * (1.0 - 1.0 / 16.0)
        floor = -0.02 * tile.unit
        up = mi.Normal3f(0, 0, 1)
        blocked = []
        for gap in (0.0, 2e-6, 1e-4):
            p = mi.Point3f(mi.Float(edge - gap), mi.Float(5.0), mi.Float(floor))
            si = tile.geometry.interaction(Vertex(p, up), mi.Vector3f(0, 0, -1), mi.Bool(True))
            ray = tile.geometry.leave(si, mi.Vector3f(d.astype(np.float32)))
            blocked.append(np.array(tile.geometry.occluded(ray, mi.Bool(True), 100)[0]).mean())
        found.append(blocked)
    assert np.abs(np.array(found[1]) - found[0]).max() < 2e-3


def test_a_mesh_too_large_for_memory_is_refused() -> None:
    cells = np.lib.stride_tricks.as_strided(np.zeros(1), (1 << 12, 1 << 13), (0, 0))
    with pytest.raises(InputError, match="--tracer heightfield"):
        build_scene(replace(HeightGrid(cells, 0.5), tracer="mesh"), lambert(0.5))

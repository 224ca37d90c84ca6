"""Unmodified Mitsuba, and triangles traced by it, give the values of the height field."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from support.mitsuba_blocks import GRIDS, SPP, block, mitsuba_halves, random_queries
from support.scenes import (
    LightKernel,
    Transport,
    build_scene,
    direction,
    directional,
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


def colors(shape: tuple[int, int] = (16, 16)) -> dict[str, Any]:
    """A Lambert reflector with a random color map, which detects flips and shifts."""
    pixels = np.random.default_rng(12).random((*shape, 3)).astype(np.float32)
    return {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}}


def heights(name: str) -> HeightGrid:
    """A synthetic height field, square or wide, or that of a material."""
    return GRIDS[name] if name in GRIDS else real_heights(name)


@pytest.mark.parametrize("shape", ["wide", "turtle_shell", "rock_cliff"])
@pytest.mark.parametrize("depth", [1, 4], ids=["direct", "interreflection"])
@pytest.mark.parametrize("sigma", [1e-6, 0.3], ids=["point", "wide"])
def test_mitsuba_agrees(shape: str, depth: int, sigma: float, tmp_path: Path) -> None:
    grid = heights(shape)
    bsdf = colors((8, 16) if shape == "wide" else (16, 16))
    omega_i = direction(40, 70)
    q = random_queries(4096, sigma, omega_i)
    # Mitsuba's depth counts the emitter's vertex too. Unit irradiance on the plane.
    a, b = mitsuba_halves(block(grid, bsdf, tmp_path), directional(omega_i), q, grid.aspect, depth + 1)
    transport = Transport(max_depth=depth, roulette_depth=1000)
    ours = estimate(grid, bsdf, LightKernel(0.0), q, SPP, transport=transport, seed=5)
    groups = elevation_groups(q.omega_o, edges=(0.0, 0.8, 1.0))
    result = aggregate_test(ours.value_a, ours.value_b, a, b, groups)
    # Mitsuba's rays leave a surface 5e-5 tile widths above it, ours 3e-7. Where point queries have next to no
    # noise, the light that slips past shadow edges shows: up to two thousandths of the mean.
    mean = float(ours.value_a.mean())
    allowed = {"mean": 2e-3 * mean, "scatter": 2e-3 * mean**2}
    for c in result.comparisons:
        assert c.corrected > 1e-3 or abs(c.estimate.value) < allowed[c.kind], str(result)
    assert mean > 0.02


def test_smoothed_emitter_in_mitsubas_integrator_agrees(tmp_path: Path) -> None:
    """The registered emitter gives each query its own smoothed light under Mitsuba's integrator."""
    grid = GRIDS["square"]
    q = random_queries(4096, 0.05)
    emitter = {"type": "mbtf_directional", "width": 5.0}
    a, b = mitsuba_halves(block(grid, colors(), tmp_path), emitter, q, 1.0, 3)
    transport = Transport(max_depth=2, roulette_depth=1000)
    ours = estimate(grid, colors(), LightKernel(5.0), q, SPP, transport=transport, seed=5)
    groups = elevation_groups(q.omega_i, edges=(0.0, 0.8, 1.0))
    result = aggregate_test(ours.value_a, ours.value_b, a, b, groups)
    assert result.p_value > 1e-3, str(result)


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

"""Tiles of triangles against closed forms, the height field's tracer, and energy conservation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from support.jobs import job_of
from support.mitsuba_shapes import tile_mesh
from support.scenes import (
    Estimator,
    LightKernel,
    Stream,
    Transport,
    build_scene,
    direction,
    estimate,
    lambert,
    queries,
    rocks,
    tile_mean_queries,
)

from mbtf_core.stats import mean_of_halves
from mbtf_gen.planning.run_plan import plan_effects, reference_plan
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.tile.loading import load_material
from mbtf_gen.tile.mesh_tile import MeshPart, MeshTile

UP = np.array([0.0, 0.0, 1.0])


def plate(low: tuple[float, float], high: tuple[float, float], z: float = 0.0) -> NDArray[np.float64]:
    """Corners (4, 3) of a horizontal rectangle, counter-clockwise from above."""
    (a, b), (c, d) = low, high
    return np.array([[a, b, z], [c, b, z], [c, d, z], [a, d, z]])


def tile_of(plates: list[NDArray[np.float64]], colors: list[float], aspect: float = 1.0) -> MeshTile:
    """A tile of rectangles, a part each."""
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return MeshTile(
        aspect,
        np.concatenate(plates),
        np.concatenate([faces + 4 * k for k in range(len(plates))]),
        np.zeros((4 * len(plates), 2)),
        np.repeat(np.arange(len(plates)), 2),
        [MeshPart(str(k), {"base_color": np.full(3, c)}) for k, c in enumerate(colors)],
    )


def traced(tile: MeshTile, light: LightKernel | None, q: Any, spp: int = 16) -> Any:
    estimator = Estimator(build_scene(tile, tile.surface()), light, Transport())
    return estimator.estimate(q, spp, Stream(1, "test", 0))


@pytest.mark.parametrize("mode", ["auto", "none"])
@pytest.mark.parametrize("gap", [0.0, 0.5])
def test_a_flat_mesh_is_lambert_with_its_gap_and_its_parts(gap: float, mode: str) -> None:
    # Two colors side by side, as seen by narrow footprints; the rest of the tile is open.
    edge = 0.5 * (1.0 - gap)
    tile = tile_of([plate((0, 0), (edge, 1)), plate((edge, 0), (2 * edge, 1))], [0.8, 0.2])
    for plan in (plan_effects(job_of(tile, mode)), reference_plan(job_of(tile, mode))):
        u = np.array([0.25 * edge, 0.75 * edge, 1.5 * edge, 0.5 + 0.6 * edge])
        light, view = direction(20, 60), direction(35, 200)
        q = queries(np.stack([u, np.full(4, 0.5)], axis=-1), 0.01 * edge, light, view, 4)
        e = build_estimator(job_of(tile, mode), plan).estimate(q, 64, Stream(1, "test", 0))
        expected = np.array([0.8, 0.8, 0.2, 0.0 if gap else 0.2]) / np.pi
        # Sampling of the BSDF too has variance where it is on.
        np.testing.assert_allclose(e.value_a[:, 0], expected, rtol=0.1)
        assert e.transmittance.tolist() == [0.0, 0.0, 0.0, 1.0 if gap else 0.0]
        mean = build_estimator(job_of(tile, mode), plan).estimate(
            tile_mean_queries(light, view, 4000), 16, Stream(1, "test", 0)
        )
        assert mean.transmittance.mean() == pytest.approx(gap, abs=0.01)
        found = mean_of_halves(mean.value_a[:, 0], mean.value_b[:, 0])
        assert abs(found.value - (1.0 - gap) * 0.5 / np.pi) < 4.0 * found.error


def test_a_plate_below_another_is_seen_through_its_gap_and_lit_from_aside() -> None:
    # A black strip above a white floor: of the floor a share is hidden, as in the closed form of a slit.
    depth, half = 0.1, 0.25
    tile = tile_of([plate((0, 0), (1, 1), -depth), plate((0.5 - half, 0), (0.5 + half, 1))], [0.5, 0.0])
    omega_i, omega_o = direction(60, 0), direction(90, 0)
    shift = depth / np.tan(np.radians(60.0))
    e = traced(tile, LightKernel(0.0), tile_mean_queries(omega_i, omega_o, 8000))
    # Seen: 1 - 2 half. Of it, a strip of `shift` is in the shadow.
    expected = 0.5 / np.pi * (1.0 - 2.0 * half - shift)
    found = mean_of_halves(e.value_a.mean(axis=1), e.value_b.mean(axis=1))
    # Nothing scatters from the black strip back to the floor, but the floor lights itself not at all.
    assert abs(found.value - expected) < 4.0 * found.error
    assert found.error < 0.01 * expected


def test_a_height_field_as_a_file_of_triangles_gives_its_values(tmp_path: Path) -> None:
    grid = rocks(32, 0.15)
    tile_mesh(grid).export(tmp_path / "rocks.ply")
    (tmp_path / "material.yaml").write_text("mesh: rocks.ply\nperiod: [1, 1]\nbase_color: 0.6\n")
    shape = load_material(tmp_path)
    assert shape.open_edges() == (0, 0)
    omega_i, omega_o = direction(35, 50), direction(25, -100)
    q = tile_mean_queries(omega_i, omega_o, 8000)
    ours = traced(shape, LightKernel(1.0), q)
    heights = estimate(grid, lambert(0.6), LightKernel(1.0), q, 16, seed=2)
    a, b = (mean_of_halves(e.value_a[:, 0], e.value_b[:, 0]) for e in (ours, heights))
    assert abs(a.value - b.value) < 4.0 * np.hypot(a.error, b.error)
    assert a.error < 0.01 * a.value
    assert ours.transmittance.max() == 0.0


def test_white_bodies_above_a_grid_return_all_light() -> None:
    rng = np.random.default_rng(0)
    balls = []
    for _ in range(12):
        ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05 + 0.1 * rng.random())
        ball.apply_translation([*rng.random(2), -0.2 - 0.2 * rng.random()])
        balls.append(ball)
    whole = trimesh.util.concatenate(balls)
    vertices = np.asarray(whole.vertices) - (0, 0, whole.vertices[:, 2].max())
    faces = np.asarray(whole.faces)
    tile = MeshTile(
        1.0,
        vertices,
        faces,
        np.zeros((len(vertices), 2)),
        np.zeros(len(faces), int),
        [MeshPart("w", {"base_color": np.ones(3)})],
    )
    e = traced(tile, None, tile_mean_queries(UP, direction(30, 20), 2000), 64)
    total = 0.5 * (e.value_a + e.value_b)[:, 0] + e.transmittance
    assert total.mean() == pytest.approx(1.0, abs=4.0 * total.std() / np.sqrt(len(total)) + 1e-4)
    assert 0.1 < e.transmittance.mean() < 0.9

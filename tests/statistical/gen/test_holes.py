"""Opacity: rays pass through holes, end in black, and are stored as transmittance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.mitsuba_blocks import GRIDS, SPP, block, mitsuba_halves, random_queries
from support.scenes import HeightGrid, LightKernel, direction, directional, flat, mi, queries, rocks
from support.significance import aggregate_test

from mbtf_core.stats import elevation_groups, mean_of_halves
from mbtf_gen.render.estimates import Stream
from mbtf_gen.render.estimator import Estimator
from mbtf_gen.render.path_tracer import Transport
from mbtf_gen.render.scene import TileScene, build_scene

N = 8000
PLANE = Transport(displacement=False, shadowing=False, interreflection=False)


def half_open(share: float = 0.0) -> np.ndarray[Any, Any]:
    """Opacity (32, 32): the left half is opaque, the right half stops a fraction `share` of the rays."""
    opacity = np.ones((32, 32), np.float32)
    opacity[:, 16:] = share
    return opacity


MASK = np.where(np.random.default_rng(3).random((12, 12)) < 0.5, 0.15, 1.0)


def nearest(pixels: Any) -> dict[str, Any]:
    """A texture of texels (rows, columns) or (rows, columns, 3) without interpolation."""
    array = np.ascontiguousarray(pixels, np.float32)
    image = mi.Bitmap(array[..., None] if array.ndim == 2 else array)
    return {"type": "bitmap", "bitmap": image, "raw": True, "filter_type": "nearest"}


def sheet(grid: HeightGrid, opacity: Any, albedo: float = 0.6) -> TileScene:
    color = {"type": "rgb", "value": [albedo] * 3}
    return build_scene(grid, {"type": "mbtf_surface", "base_color": color, "opacity": nearest(opacity)})


def run(
    tile: TileScene,
    transport: Transport,
    sigma: float = 4.0,
    u: Any = (0.5, 0.5),
    spp: int = 8,
    **options: Any,
) -> Any:
    q = queries(u, sigma, direction(50, 20), direction(60, 200), N)
    return Estimator(tile, LightKernel(2.0), transport).estimate(q, spp, Stream(5, "test", 0), **options)


@pytest.mark.parametrize("transport", [PLANE, Transport()], ids=["plane", "traced"])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_a_sheet_with_holes(transport: Transport, share: float) -> None:
    """A plane: the value is albedo/π times the mean opacity, the transmittance the rest."""
    e = run(sheet(flat(), half_open(share)), transport)
    opaque = 0.5 + 0.5 * share
    value = mean_of_halves(e.value_a[:, 0], e.value_b[:, 0])
    assert abs(value.value - opaque * 0.6 / np.pi) < 4 * value.error < 0.004
    assert e.transmittance.mean() == pytest.approx(1 - opaque, abs=4 * 0.5 / np.sqrt(8 * N))
    assert e.lost == 0


def test_holes_lie_where_the_map_says() -> None:
    """Row 0 is the side v → 1, column 0 the side u → 0."""
    opacity = np.ones((32, 32))
    opacity[:8, 24:] = 0.0
    u = np.random.default_rng(0).random((N, 2))
    e = run(sheet(flat(), opacity), PLANE, sigma=1e-6, u=u, spp=2)
    inside = (u[:, 0] > 0.75) & (u[:, 1] > 0.75)
    np.testing.assert_array_equal(e.transmittance, inside)
    assert not e.value_a[inside].any()
    assert (e.value_a[~inside] > 0).all()


def test_paths_cut_at_the_cap_have_not_passed() -> None:
    """Where nothing stops a ray, each ray either passes or reaches the cap, and all are counted."""
    n, spp = 1000, 4
    q = queries((0.5, 0.5), 0.3, direction(50, 20), direction(8, 200), n)
    tile = sheet(rocks(), np.zeros((4, 4)))
    e = Estimator(tile, LightKernel(2.0), Transport(max_crossings=1)).estimate(q, spp, Stream(5, "test", 0))
    assert 0.1 * n * spp < e.capped < 0.9 * n * spp
    assert float(e.transmittance.sum(dtype=np.float64)) * spp + e.capped == n * spp
    assert not e.value_a.any()
    assert e.lost == 0


def test_resampled_paths_have_consistent_transmittance() -> None:
    """With one path per half, the transmittance is the fraction of stored halves that hit nothing."""
    n, bad = 4000, 0.1
    pixels = np.full((1, 20, 3), 0.5)
    pixels[:, :2] = np.nan
    tile = build_scene(flat(), {"type": "mbtf_surface", "base_color": nearest(pixels), "opacity": 0.5})
    q = queries((0.5, 0.5), 4.0, direction(50, 20), direction(60, 200), n)
    e = Estimator(tile, LightKernel(2.0), PLANE).estimate(q, 2, Stream(5, "test", 0))
    assert e.nonfinite == pytest.approx(2 * n * 0.5 * bad / (1 - 0.5 * bad), rel=0.2)
    halves = np.stack([e.value_a, e.value_b])[..., 0]
    np.testing.assert_array_equal(e.transmittance, (halves == 0).mean(axis=0))
    # Of the paths that may be stored, more pass than of all.
    expected = 0.5 / (1 - 0.5 * bad)
    assert abs(e.transmittance.mean() - expected) < 4 * np.sqrt(expected * (1 - expected) / (2 * n))


def test_an_opaque_map_changes_nothing() -> None:
    """Opacity decisions use no dimension of a path's sequence."""
    closed = sheet(rocks(), np.ones((4, 4)))
    plain = build_scene(rocks(), {"type": "mbtf_surface", "base_color": {"type": "rgb", "value": [0.6] * 3}})
    a, b = run(closed, Transport()), run(plain, Transport())
    assert (a.value_a == b.value_a).all()
    assert (a.value_b == b.value_b).all()
    assert not a.transmittance.any()
    assert b.transmittance is None


@pytest.mark.parametrize("depth", [1, 4], ids=["direct", "interreflection"])
def test_mitsuba_agrees_on_a_height_field_with_an_opacity_mask(depth: int, tmp_path: Path) -> None:
    """Mitsuba's ``mask`` over a block of tiles under ``volpath``, whose shadow rays pass through holes."""
    opacity, color = nearest(MASK), {"type": "rgb", "value": [0.7, 0.5, 0.3]}
    grid = GRIDS["square"]
    omega_i = direction(22, 70)
    q = random_queries(4096, 0.02, omega_i)
    mask = {"type": "mask", "opacity": opacity, "bsdf": {"type": "diffuse", "reflectance": color}}
    a, b = mitsuba_halves(block(grid, mask, tmp_path), directional(omega_i), q, 1.0, depth + 1, "volpath")
    tile = build_scene(grid, {"type": "mbtf_surface", "base_color": color, "opacity": opacity})
    transport = Transport(max_depth=depth, roulette_depth=1000)
    ours = Estimator(tile, LightKernel(0.0), transport).estimate(q, SPP, Stream(5, "test", 0))
    result = aggregate_test(
        ours.value_a, ours.value_b, a, b, elevation_groups(q.omega_o, edges=(0.0, 0.8, 1.0))
    )
    assert result.p_value > 1e-3, str(result)
    assert 0.1 < ours.transmittance.mean() < 0.9


def test_transmittance_agrees_with_mitsuba(tmp_path: Path) -> None:
    """Transmittance against Mitsuba's render of a black sheet over a glowing floor."""
    opacity = nearest(MASK)
    grid = GRIDS["square"]
    q = random_queries(4096, 0.02, elevation=45.0)
    black = {"type": "rgb", "value": 0.0}
    mask = {"type": "mask", "opacity": opacity, "bsdf": {"type": "diffuse", "reflectance": black}}
    to_world = mi.ScalarTransform4f().translate([0, 0, -12]) @ mi.ScalarTransform4f().scale(1000)
    glow = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    floor = {"type": "rectangle", "to_world": to_world, "emitter": glow}
    a, b = mitsuba_halves(
        block(grid, mask, tmp_path), {"type": "constant", "radiance": black}, q, 1.0, 30, "path", floor
    )
    tile = build_scene(grid, {"type": "mbtf_surface", "base_color": black, "opacity": opacity})
    ours = Estimator(tile, LightKernel(0.0), Transport(max_depth=1)).estimate(q, SPP, Stream(5, "test", 0))
    seen = mean_of_halves(a[:, 0] - ours.transmittance, b[:, 0] - ours.transmittance)
    error = np.sqrt(2 * np.mean(a[:, 0] * (1 - a[:, 0])) / SPP / len(a))
    assert abs(seen.value) < 4 * error + 1e-3
    assert np.corrcoef(0.5 * (a + b)[:, 0], ours.transmittance)[0, 1] > 0.8


def test_pictures_store_the_transmittance(tmp_path: Path) -> None:
    """A picture straight from above shows the holes where the map has them, and stores them."""
    from mbtf_core.images.exr import read_layers
    from mbtf_core.pictures import Camera
    from mbtf_gen.pictures.reference import render_reference

    camera = Camera(90.0, -90.0, tiles_across=1.0, rows=16, columns=16)
    estimator = Estimator(sheet(flat(), half_open()), LightKernel(2.0), PLANE)
    image = render_reference(estimator, camera, direction(50, 20), kind="pixel", spp=8)
    np.testing.assert_allclose(image.transmittance[:, [2, 4, 11, 13]], np.tile([0, 0, 1, 1], (16, 1)))
    exr = image.write(tmp_path / "picture")
    np.testing.assert_array_equal(read_layers(exr, 10_000)[0]["transmittance"], image.transmittance)

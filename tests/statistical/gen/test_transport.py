"""Rays over the periodic tile that hit nothing, and bounces without a density: mirrors, voids, caps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import (
    DIRECT,
    HeightGrid,
    LightKernel,
    build_scene,
    direction,
    estimate,
    flat,
    lambert,
    mi,
    queries,
    rocks,
    tile_mean_queries,
)

MIRROR = {"type": "conductor", "material": "none"}
# A trough along y: walls one tile width high, the floor between them flat.
TROUGH = HeightGrid(np.tile([0.0, -1.0, -1.0, -1.0], (4, 1)), 1.0)


@pytest.mark.parametrize("width", [0.5, 5.0])
def test_a_mirror_shows_the_light_itself(width: float) -> None:
    """Light samples never hit a mirror's lobe, so the bounce carries all of the radiance."""
    light = LightKernel(width)
    omega_i, omega_o = direction(50, 30), direction(50 + width, 210 - width)
    e = estimate(flat(), MIRROR, light, queries([0.2, 0.6], 0.1, omega_i, omega_o, 8), 4)
    expected = light.radiance(omega_o * [-1, -1, 1], omega_i)
    np.testing.assert_allclose([e.value_a, e.value_b], expected, rtol=1e-3)


def test_rays_that_meet_nothing_are_black_and_counted() -> None:
    """A user-supplied BSDF transmits rays in the middle half of the tile."""
    through = np.ones((8, 8, 1), np.float32)
    through[2:6, 2:6] = 0.0
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(through), "raw": True, "filter_type": "nearest"}
    n, spp = 1000, 4
    u = np.random.default_rng(0).random((n, 2))
    q = queries(u, 1e-6, [0, 0, 1], direction(70, 20), n)
    e = estimate(flat(), {"type": "mask", "opacity": bitmap, "bsdf": lambert(1.0)}, None, q, spp)
    solid = ~np.all(np.abs(u - 0.5) < 0.25, axis=1)
    np.testing.assert_allclose(e.value_a[:, 0], solid, atol=1e-5)
    assert e.lost == spp * np.sum(~solid)


def test_rays_below_the_surface_meet_it_from_below() -> None:
    """White, half transparent: every path ends in the sky or is counted as lost."""
    n, spp = 4000, 16
    white = {"type": "twosided", "bsdf": lambert(1.0)}
    ridges = HeightGrid(np.tile([0.0, -0.5], (2, 1)), 1.0)
    q = tile_mean_queries([0, 0, 1], direction(30, 0), n)
    e = estimate(ridges, {"type": "mask", "opacity": 0.5, "bsdf": white}, None, q, spp)
    seen = 0.5 * (e.value_a.mean() + e.value_b.mean())
    assert 0.1 < seen < 0.9
    assert seen + e.lost / (n * spp) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("cap", [0, 5, 100])
def test_endless_rays_end_at_the_cap(cap: int) -> None:
    """A level ray inside a trough is capped, a shadow ray occluded."""
    tile = build_scene(TROUGH, lambert(0.5))
    z = -0.9 * tile.unit
    ray = mi.Ray3f(mi.Point3f([0.0, 0.5], 0.0, z), mi.Vector3f(0.0, [1.0, -1.0], 0.0))
    si, crossings, capped, _ = tile.geometry.closest_hit(ray, mi.Bool(True), cap)
    assert not np.any(np.array(si.is_valid()))
    assert np.all(np.array(capped))
    assert list(np.array(crossings)) == [cap, cap]
    blocked, crossings, capped, _ = tile.geometry.occluded(ray, mi.Bool(True), cap)
    assert np.all(np.array(blocked))
    assert np.all(np.array(capped))
    assert list(np.array(crossings)) == [cap, cap]


def test_rays_that_leave_upwards_are_neither_capped_nor_occluded() -> None:
    tile = build_scene(TROUGH, lambert(0.5))
    ray = mi.Ray3f(mi.Point3f(0.0, 0.0, -0.1 * tile.unit), mi.Vector3f(0.0, [1.0, -0.6], [0.1, 0.8]))
    blocked, crossings, capped, _ = tile.geometry.occluded(ray, mi.Bool(True), 4096)
    assert not np.any(np.array(blocked | capped))
    # 0.1 tile widths up at a slope of 0.1 is one tile width along; the steep ray crosses none.
    assert list(np.array(crossings)) == [1, 0]


def test_a_low_cap_darkens_and_is_counted() -> None:
    """Light beyond the cap is missing from the values, never added."""
    q = tile_mean_queries(direction(1.0, 30), direction(60, 200), 2000)
    full, cut = (
        estimate(rocks(), lambert(0.8), LightKernel(0.0), q, 8, transport=replace(DIRECT, max_crossings=c))
        for c in (4096, 0)
    )
    assert full.capped == 0
    assert cut.capped > 100
    # The same paths, some of them dark.
    assert np.all(cut.value_a <= full.value_a + 1e-6)
    assert cut.value_a.mean() < 0.9 * full.value_a.mean()

"""Rays over the repeated tile that end nowhere, and bounces without a density: mirrors, voids, caps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.scenes import (
    DIRECT,
    HeightGrid,
    LightKernel,
    Transport,
    build_tile,
    direction,
    estimate,
    flat,
    lambert,
    mi,
    queries,
    rocks,
    tile_mean_queries,
)

from mbtf_gen.bsdf import surface_of
from mbtf_gen.estimator import Estimator, Stream
from mbtf_gen.periodic import closest_hit, occluded
from mbtf_gen.stats import mean_of_halves

MIRROR = {"type": "conductor", "material": "none"}
# A trough along y: walls one tile width high, the floor between them flat.
TROUGH = HeightGrid(np.tile([0.0, -1.0, -1.0, -1.0], (4, 1)), 1.0)


@pytest.mark.parametrize("width", [0.5, 5.0])
def test_a_mirror_shows_the_light_itself(width: float) -> None:
    """No sample of the light reaches a mirror's lobe: the bounce carries all of the radiance, unweighted."""
    light = LightKernel(width)
    omega_i, omega_o = direction(50, 30), direction(50 + width, 210 - width)
    e = estimate(flat(), MIRROR, light, queries([0.2, 0.6], 0.1, omega_i, omega_o, 8), 4)
    expected = light.radiance(omega_o * [-1, -1, 1], omega_i)
    np.testing.assert_allclose([e.value_a, e.value_b], expected, rtol=1e-3)


def void(normal: tuple[float, float, float], bsdf: dict[str, Any]) -> Any:
    """A tile in which nothing is left but one huge facet through the origin."""
    tile = build_tile(HeightGrid(np.array([[0.0, -30.0], [-30.0, -30.0]]), 1.0), lambert(0.5))
    facet = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], list(normal), [0, 1, 0])
        @ mi.ScalarTransform4f().scale(8.0),
        "bsdf": bsdf,
    }
    scene = mi.load_dict({"type": "scene", "facet": facet})
    surface = surface_of(scene.shapes()[0].bsdf())
    return replace(tile, world=replace(tile.world, scene=scene, surface=surface))


def test_rays_lost_below_the_horizon_bring_no_light_and_are_counted() -> None:
    """A facet tilted by 45° sees (1 + cos 45°)/2 of the sky; what it sends down is lost."""
    n, spp = 4000, 16
    tile = void((1.0, 0.0, 1.0), lambert(1.0))
    q = queries([0.5, 0.5], 1e-6, [0, 0, 1], [0, 0, 1], n)
    e = Estimator(tile, None, Transport(max_depth=1)).estimate(q, spp, Stream(0, "test", 0))
    mean = mean_of_halves(e.value_a[:, 0], e.value_b[:, 0])
    seen = 0.5 * (1 + np.sqrt(0.5))
    assert abs(mean.value - seen) < 4 * mean.error < 0.01
    assert e.lost == pytest.approx((1 - seen) * n * spp, rel=0.05)


def test_rays_that_meet_nothing_are_black_and_counted() -> None:
    tile = void((0.0, 0.0, 1.0), lambert(1.0))
    n = 1000
    u = np.random.default_rng(0).random((n, 2))
    e = Estimator(tile, None, Transport()).estimate(
        queries(u, 1e-6, [0, 0, 1], [0, 0, 1], n), 4, Stream(0, "test", 0)
    )
    # The facet covers the middle half of the tile in both directions.
    hit = np.all(np.abs(u - 0.5) < 0.25, axis=1)
    np.testing.assert_allclose(e.value_a[:, 0], hit, atol=1e-5)
    assert e.lost == 4 * np.sum(~hit)


@pytest.mark.parametrize("cap", [0, 5, 100])
def test_endless_rays_end_at_the_cap(cap: int) -> None:
    """A level ray inside a trough never hits and never leaves: it counts as capped, a shadow ray as
    occluded."""
    tile = build_tile(TROUGH, lambert(0.5))
    z = -0.9 * tile.unit
    ray = mi.Ray3f(mi.Point3f([0.0, 0.5], 0.0, z), mi.Vector3f(0.0, [1.0, -1.0], 0.0))
    si, crossings, capped, _ = closest_hit(tile.scene, tile.period, ray, mi.Bool(True), cap)
    assert not np.any(np.array(si.is_valid()))
    assert np.all(np.array(capped))
    assert list(np.array(crossings)) == [cap, cap]
    blocked, crossings, capped, _ = occluded(tile.scene, tile.period, ray, mi.Bool(True), cap)
    assert np.all(np.array(blocked))
    assert np.all(np.array(capped))
    assert list(np.array(crossings)) == [cap, cap]


def test_rays_that_leave_upwards_are_neither_capped_nor_occluded() -> None:
    tile = build_tile(TROUGH, lambert(0.5))
    ray = mi.Ray3f(mi.Point3f(0.0, 0.0, -0.1 * tile.unit), mi.Vector3f(0.0, [1.0, -0.6], [0.1, 0.8]))
    blocked, crossings, capped, _ = occluded(tile.scene, tile.period, ray, mi.Bool(True), 4096)
    assert not np.any(np.array(blocked | capped))
    # 0.1 tile widths up at a slope of 0.1 is one tile width along; the steep ray crosses none.
    assert list(np.array(crossings)) == [1, 0]


def test_a_low_cap_darkens_and_is_counted() -> None:
    """Light that the cap cuts off is missing from the values, never invented."""
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


def test_white_furnace_of_a_deep_trough() -> None:
    """Paths of more bounces than roulette's patience still bring all of their light back.

    Much deeper, their weights vary so much that error bars mean little.
    """
    trough = HeightGrid(4.0 * TROUGH.z, 1.0)
    q = tile_mean_queries([0, 0, 1], direction(80, 0), 20_000)
    e = estimate(trough, lambert(1.0), None, q, 16)
    mean = mean_of_halves(e.value_a[:, 0], e.value_b[:, 0])
    assert mean.error < 5e-4
    assert abs(mean.value - 1.0) < 5 * mean.error
    assert e.capped == 0

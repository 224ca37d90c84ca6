"""Fibers against energy conservation, the integral of their scattering, and unmodified Mitsuba."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.mitsuba_blocks import instances
from support.mitsuba_shapes import mitsuba_shapes
from support.scenes import (
    DIRECT,
    Estimator,
    LightKernel,
    Stream,
    Transport,
    build_scene,
    direction,
    directional,
    lambert,
    mi,
    queries,
    tile_mean_queries,
)

from mbtf_core.stats import Estimate, mean_of_halves
from mbtf_gen.tile.fiber_tile import FiberScattering, FiberTile
from mbtf_gen.tile.fibers.cloth_file import YarnEntry
from mbtf_gen.tile.fibers.curves import THINNEST, Curve

WHITE = (1.0, 1.0, 1.0)
GRAY = (0.8, 0.6, 0.3)
ALONG_X, ALONG_Y, UP = np.eye(3)


def felt(
    count: int, radius: float, colors: Sequence[Sequence[float]] = (WHITE,), aspect: float = 1.0
) -> FiberTile:
    """Wavy fibers along both sides of the tile, at random depths."""
    rng = np.random.default_rng(0)
    s = np.arange(10) / 10
    curves = []
    for k in range(count):
        wave = 2.0 * np.pi * (s + rng.random())
        across, down = rng.random() + 0.06 * np.sin(wave), 0.03 * np.cos(wave) - 0.25 * rng.random()
        points = np.column_stack([s, across * aspect, down] if k % 2 else [across, s * aspect, down])
        if k % 5:
            curves.append(Curve.through(points, radius, ALONG_X if k % 2 else ALONG_Y * aspect))
        else:
            curves.append(Curve(np.column_stack([points, radius * (0.5 + np.sin(np.pi * s))])))
    # Twice as many of the first color.
    yarn = np.where(np.arange(count) % 3 == 2, len(colors) - 1, 0)
    scattering = (FiberScattering(0.35, 0.4, 3.0),) * len(colors)
    return FiberTile.settled(aspect, curves, yarn, np.array(colors), scattering)


def cylinder(radius: float) -> FiberTile:
    """One straight fiber along x."""
    points = np.arange(6)[:, None] / 6 * ALONG_X + (0.0, 0.5, 0.0)
    curve = Curve.through(points, radius, ALONG_X)
    scattering = FiberScattering(0.3, 0.3, 2.0)
    return FiberTile.settled(1.0, [curve], np.zeros(1, int), np.array([GRAY]), (scattering,))


def traced(
    tile: FiberTile, light: LightKernel | None, transport: Transport | None = None, bsdf: Any = None
) -> Estimator:
    return Estimator(build_scene(tile, bsdf or tile.surface()), light, transport or Transport())


def mean_value(
    tile: FiberTile,
    omega_i: NDArray[np.float64],
    omega_o: NDArray[np.float64],
    n: int,
    bsdf: Any = None,
) -> list[Estimate]:
    """Tile means of the channels under a delta light."""
    estimator = traced(tile, LightKernel(0.0), bsdf=bsdf)
    e = estimator.estimate(tile_mean_queries(omega_i, omega_o, n), 64, Stream(3, "test", 0))
    return [mean_of_halves(e.value_a[:, k], e.value_b[:, k]) for k in range(3)]


@pytest.mark.parametrize(
    "fiber",
    [
        {"roughness": 0.08, "azimuthal_roughness": 0.02, "ior": 1.1},
        {"roughness": 0.08, "azimuthal_roughness": 1.0, "ior": 2.0, "scale_tilt": 10.0},
        {"roughness": 1.0, "azimuthal_roughness": 0.02, "ior": 1.55, "scale_tilt": -10.0},
    ],
)
def test_no_light_is_lost_where_the_schema_ends(fiber: dict[str, float]) -> None:
    y = YarnEntry.model_validate(fiber)
    scattering = FiberScattering(y.roughness, y.azimuthal_roughness, y.scale_tilt, y.ior)
    tile = replace(felt(60, 0.02), scattering=(scattering,))
    e = traced(tile, None).estimate(tile_mean_queries(UP, direction(25, 40), 400), 64, Stream(1, "test", 0))
    total = 0.5 * (e.value_a + e.value_b).mean(axis=1) + e.transmittance
    # Mitsuba gives one sample in 10⁴ no density.
    assert abs(total.mean() - 1.0) < 5e-4
    assert e.nonfinite == 0


@pytest.mark.parametrize(("count", "radius"), [(60, 0.02), (300, 0.004), (40, 1e-4), (40, 1e-5)])
def test_white_fibers_return_constant_light_at_any_depth(count: int, radius: float) -> None:
    tile = felt(count, radius)
    e = traced(tile, None).estimate(tile_mean_queries(UP, direction(25, 40), 400), 64, Stream(1, "test", 0))
    # What the fibers send back, and what passes between them.
    total = 0.5 * (e.value_a + e.value_b).mean(axis=1) + e.transmittance
    assert np.abs(total - 1.0).max() < 1e-4
    assert (e.lost, e.capped, e.nonfinite) == (0, 0, 0)
    assert e.transmittance.mean() == pytest.approx({60: 0.0, 300: 0.1, 40: 0.99}[count], abs=0.12)


def test_one_straight_fiber_is_the_integral_of_its_scattering_function() -> None:
    radius = 0.05
    tile = cylinder(radius)
    omega_i, omega_o = direction(50, 70), direction(35, -60)
    e = traced(tile, LightKernel(0.0), DIRECT).estimate(
        tile_mean_queries(omega_i, omega_o, 40_000), 16, Stream(2, "test", 0)
    )
    measured = mean_of_halves(e.value_a.mean(axis=1), e.value_b.mean(axis=1))
    # Rays hit the fiber at the offset h in [-1, 1] from its axis, seen along ω_o across x. Frames: x around
    # the fiber, y along it, z the normal.
    bsdf = mi.load_dict(tile.surface())
    h = (np.arange(4000) + 0.5) / 2000 - 1.0
    across = np.array([0.0, *omega_o[1:]]) / np.hypot(*omega_o[1:])
    side = np.cross(ALONG_X, across)
    normal = h[:, None] * side + np.sqrt(1.0 - h[:, None] ** 2) * across
    around = np.cross(ALONG_X, normal)

    def local(w: NDArray[np.float64]) -> Any:
        return mi.Vector3f(*(mi.Float(f @ w) for f in (around, np.tile(ALONG_X, (len(h), 1)), normal)))

    si = mi.SurfaceInteraction3f()
    si.wi, si.uv, si.t = local(omega_o), mi.Point2f(0.5), mi.Float(0.0)
    value = np.array(bsdf.eval(mi.BSDFContext(), si, local(omega_i))).mean()
    share = 2.0 * radius * np.hypot(*omega_o[1:]) / omega_o[2]
    expected = share * value / omega_i[2]
    assert abs(measured.value / expected - 1.0) < 4.0 * measured.error / expected + 1e-3
    assert measured.error / expected < 0.01


def test_opaque_fibers_of_each_yarn_reflect_by_their_own_fresnel() -> None:
    """Seen at right angles to a fiber, the offset from its axis is uniform."""
    indices = (1.7, 1.25)
    curves = [cylinder(0.002).curves[0].moved(np.array([0.0, y, 0.0])) for y in (-0.25, 0.25)]
    scattering = tuple(FiberScattering(0.3, 0.3, 0.0, ior) for ior in indices)
    tile = FiberTile.settled(1.0, curves, np.arange(2), np.array([GRAY, GRAY]), scattering)
    estimator = traced(tile, None, bsdf=tile.surface(()))
    offset = (np.arange(20_000) + 0.5) / 20_000
    cosine = np.sqrt(1.0 - offset**2)
    for half, ior in enumerate(indices):
        u = np.random.default_rng(half).random((4000, 2)) * (1.0, 0.02) + (0.0, 0.24 + 0.5 * half)
        e = estimator.estimate(queries(u, 1e-4, UP, UP, 4000), 32, Stream(5, "test", half))
        inside = np.sqrt(1.0 - (offset / ior) ** 2)
        parallel = (ior * cosine - inside) / (ior * cosine + inside)
        vertical = (cosine - ior * inside) / (cosine + ior * inside)
        expected = 0.2 * np.mean(0.5 * (parallel**2 + vertical**2))
        found = mean_of_halves(e.value_a[:, 1], e.value_b[:, 1])
        assert found.error < 0.02 * expected
        assert abs(found.value - expected) < 4 * found.error + 5e-3 * expected


def test_thin_fibers_do_not_shadow_themselves() -> None:
    # The same integral is proportional to the radius, whatever the radius is.
    omega_i, omega_o = direction(50, 70), direction(35, -60)
    found = []
    for radius in (1e-2, 1e-4, THINNEST):
        # All queries on the fiber: footprints of its width.
        u = np.column_stack([np.random.default_rng(0).random(4000), np.full(4000, 0.5)])
        q = queries(u, 3.0 * radius, omega_i, omega_o, 4000)
        e = traced(cylinder(radius), LightKernel(0.0)).estimate(q, 64, Stream(5, "test", 0))
        found.append(mean_of_halves(e.value_a.mean(axis=1), e.value_b.mean(axis=1)))
    large, *thin = found
    for small in thin:
        error = np.hypot(small.error / small.value, large.error / large.value)
        assert abs(small.value / large.value - 1.0) < 4.0 * error
        assert error < 0.01


@pytest.mark.parametrize(("radius", "loss"), [(1e-3, 3e-4), (1e-4, 3e-4), (2e-5, 1e-3), (THINNEST, 2e-3)])
@pytest.mark.parametrize("view", [(90, 0), (60, 30), (20, 20), (5, 45)])
def test_rays_hit_thin_fibers(view: tuple[float, float], radius: float, loss: float) -> None:
    """As many rays as pass the axis of a long straight fiber at less than its radius."""
    points = np.arange(4)[:, None] / 4 * ALONG_X + (0.0, 0.95, 0.0)
    curve = Curve.through(points, radius, ALONG_X)
    geometry = FiberTile.settled(1.0, [curve], np.zeros(1, int), np.array([GRAY])).trace(32.0)
    rng, n = np.random.default_rng(0), 1 << 17
    d = -direction(*view)
    across = np.cross(d, ALONG_X)
    across /= np.linalg.norm(across)
    axis = np.array([0.0, 0.45, -radius])
    aim = axis + np.outer(rng.random(n) - 0.5, ALONG_X)
    aim += np.outer(3.0 * radius * (rng.random(n) - 0.5), across)
    above = np.outer((aim[:, 2] - 1e-3) / d[2], d)
    o, d = (32.0 * (aim - above)).astype(np.float32), d.astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(*(mi.Float(float(x)) for x in d)))
    si, *_ = geometry.closest_hit(ray, mi.Mask(np.ones(n, bool)), 1000)
    # In double precision, from the rounded rays.
    across = np.cross(d.astype(np.float64), ALONG_X)
    expected = np.abs((o - 32.0 * axis) @ across) < 32.0 * radius * np.linalg.norm(across)
    assert 0.6 < expected.mean() < 0.7
    assert abs(np.count_nonzero(si.is_valid()) / np.count_nonzero(expected) - 1.0) < loss


def test_diffuse_tubes_are_reciprocal() -> None:
    # The scattering model of Chiang et al. is not: its absorption depends on the view alone.
    tile = felt(80, 0.012)
    a, b = direction(60, 20), direction(25, 200)
    forth, back = (mean_value(tile, i, o, 6000, lambert(0.7))[0] for i, o in ((a, b), (b, a)))
    error = float(np.hypot(forth.error, back.error))
    assert abs(forth.value - back.value) < 4.0 * error
    assert error < 0.02 * forth.value


@pytest.mark.parametrize("aspect", [1.0, 0.7])
def test_the_tile_repeats(aspect: float) -> None:
    tile = felt(50, 0.01, (GRAY,), aspect=aspect)
    rng = np.random.default_rng(4)
    u = rng.random((3000, 2))
    omega_i, omega_o = direction(8, 100), direction(6, 33)
    moved = np.array([0.37, 0.61 * aspect, 0.0])
    other = FiberTile(aspect, [c.moved(moved) for c in tile.curves], tile.yarn, tile.colors, tile.scattering)
    found = []
    for fibers, where in ((tile, u), (tile, u + np.array([3, -2])), (other, u + np.array([0.37, 0.61]))):
        q = queries(where, 0.01, omega_i, omega_o, len(u))
        e = traced(fibers, LightKernel(1.0), DIRECT).estimate(q, 8, Stream(6, "test", 0))
        found.append(np.stack([e.value_a, e.value_b]))
    # Rounding of the positions sends a few paths past another fiber.
    for value in found[1:]:
        assert np.mean(np.abs(value - found[0]) < 1e-4 * found[0].mean()) > 0.97
        assert value.mean() == pytest.approx(found[0].mean(), rel=5e-3)


def test_fibers_agree_with_instances_in_unmodified_mitsuba(tmp_path: Path) -> None:
    tile = felt(60, 0.015, ((0.95, 0.5, 0.05), (0.05, 0.5, 0.95)))
    unit = 32.0
    omega_i = direction(50, 25)
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": -1, "rr_depth": 1000, "hide_emitters": True},
            "group": {"type": "shapegroup", **mitsuba_shapes(tile, unit, tmp_path, {})},
            **instances(unit, unit),
            "light": directional(omega_i),
            "sensor": {
                "type": "orthographic",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 10], [0, 0, 0], [0, 1, 0])
                @ mi.ScalarTransform4f().scale([0.5 * unit, 0.5 * unit, 1.0]),
                "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}},
            },
        }
    )
    runs = [np.array(mi.render(scene, spp=64, seed=k), np.float64).mean(axis=(0, 1)) for k in range(12)]
    theirs, error = np.mean(runs, axis=0), np.std(runs, axis=0, ddof=1) / np.sqrt(len(runs))
    found = mean_value(tile, omega_i, UP, 10_000)
    for channel, ours in enumerate(found):
        both = float(np.hypot(ours.error, error[channel]))
        assert abs(ours.value - theirs[channel]) < 4.0 * both
        assert both < 0.025 * theirs[channel]
    # Exchanged colors would be seen.
    assert abs(theirs[0] / theirs[2] - 1.0) > 0.2

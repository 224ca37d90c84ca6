"""Light over curved surfaces: horizons, facets at depths, light from below the plane."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.known_surfaces import heights_at, rough_heights
from support.plugin_materials import write_material
from support.scenes import mi

from mbtf_fit.backends.mitsuba import load_scene
from mbtf_fit.backends.mitsuba.evaluator import Evaluator
from mbtf_fit.backends.mitsuba.shade import OCCLUDER, SURROUNDINGS, DirectLight
from mbtf_fit.backends.mitsuba.stored_material import read_material
from mbtf_fit.ops import Shade
from mbtf_gen.pictures.shapes import Chart

DEPTH = 0.25


def lit_from(
    z: float, bend: float, height: float = -0.05, depth: float = 0.1, places: int = 1
) -> DirectLight:
    """Light at an elevation over a sphere, and places at a height."""
    light, form = mi.Vector3f(float(np.sqrt(1 - z**2)), 0.0, z), mi.Vector3f(bend, 0.0, bend)
    heights = [mi.Float(height)] * places
    return DirectLight(light, mi.Float(0.1), mi.Bool(False), form, mi.Float(depth), heights)


@pytest.mark.parametrize("kappa", [-0.5, -0.2, 0.2, 0.5])
def test_horizons_change_as_they_do_over_a_sphere(kappa: float) -> None:
    """Those of points on the heights, stepped over the sphere, are closer than those of a plane. None is
    below the lowest."""
    n, random, radius = 4000, np.random.default_rng(6), 1.0 / kappa
    z = rough_heights(16, 16, DEPTH).astype(np.float64)
    x, y = np.arange(16) / 16, np.arange(16)[:, None] / 16
    z = 0.05 * z - 0.1 - 0.05 * np.sin(4 * np.pi * x) - 0.05 * np.cos(4 * np.pi * y)
    u, v, azimuth = random.random(n), random.random(n), random.uniform(0, 2 * np.pi, n)
    start, s = heights_at(z, u, v), np.linspace(0, 1, 1001)[1:, None]
    ground = heights_at(z, u + s * np.cos(azimuth), v + s * np.sin(azimuth))
    plane = np.maximum(np.arctan((ground - start) / s).max(0), 0.0)
    up = (radius + ground) * np.cos(s / radius) - radius - start
    sphere = np.arctan(up / ((radius + ground) * np.sin(s / radius))).max(0)
    x, y, height, given = (
        mi.Float(a.astype(np.float32)) for a in (np.cos(azimuth), np.sin(azimuth), start, plane)
    )
    form, depth = mi.Vector3f(kappa, 0.0, kappa), mi.Float(-z.min())
    lit = DirectLight(mi.Vector3f(x, y, 0.0), mi.Float(0.1), mi.Bool(False), form, depth, [height])
    found = np.array(lit.horizon(given, 0))
    assert np.mean((found - sphere) ** 2) < 0.6 * np.mean((plane - sphere) ** 2)
    assert sphere.min() > np.array(lit.lowest).min() - 0.01
    assert 0.6 < (found - plane).mean() / (sphere - plane).mean() < 1.4
    flat = replace(lit, flat=mi.Bool(True)).horizon(given, 0)
    np.testing.assert_array_equal(np.array(flat), np.array(given))


@pytest.mark.parametrize("kappa", [-0.8, 0.8])
@pytest.mark.parametrize("distance", [0.05, 0.2, 0.5])
def test_a_ridge_sinks_as_it_does_over_a_sphere(kappa: float, distance: float) -> None:
    """At the height that occluders are taken to have, from the sphere's center."""
    height, radius = -0.4, 1.0 / kappa
    top = (1.0 - OCCLUDER) * height
    up = (radius + top) * np.cos(distance / radius) - radius - height
    expected = np.arctan2(up, (radius + top) * np.sin(distance / radius))
    plane = float(np.arctan((top - height) / distance))
    found = np.array(lit_from(0.0, kappa, height, 0.4).horizon(mi.Float(plane), 0))[0]
    assert abs(found - expected) < 0.1 * abs(plane - expected) + 1e-3


@pytest.mark.parametrize("bend", [0.0, 0.3, 2.0])
def test_the_lowest_horizon_is_that_of_a_sphere(bend: float) -> None:
    """From the top of the shell to its bottom, where the light reaches no more."""
    lowest = float(np.array(lit_from(0.0, bend).lowest)[0])
    assert lowest == pytest.approx(-np.arccos(1 - bend * 0.1), abs=1e-4)
    light = lit_from(float(np.sin(lowest)), bend)
    assert np.array(light.reach)[0] == pytest.approx(0.0, abs=1e-5)


def test_no_horizon_is_below_the_surroundings() -> None:
    """Of a place near the top that nothing shadows."""
    found = np.array(lit_from(0.0, 2.0, -0.05, DEPTH).horizon(mi.Float(0.0), 0))[0]
    assert found == pytest.approx(-np.arccos(1 - 2.0 * SURROUNDINGS * (DEPTH - 0.05)), abs=2e-3)


def test_the_plugin_is_lit_from_just_below_the_plane(tmp_path: Path) -> None:
    """A sphere, and not from far below."""
    write_material(tmp_path, model="relief", finest=3)
    bsdf = {"type": "mbtf", "material": str(tmp_path), "silhouettes": True, "sigma": 0.1}
    scene = load_scene({"type": "scene", "mesh": Chart("sphere", 8, 1.0).mesh(None, bsdf)})
    aim = mi.Float(np.linspace(-0.5, 0.5, 100).astype(np.float32))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(-9.0, aim, 0.1), mi.Vector3f(1, 0, 0)))
    below, far = (
        np.array(si.bsdf().eval(mi.BSDFContext(), si, mi.Vector3f(float(np.sqrt(1 - z**2)), 0.0, z)))
        for z in (-0.05, -0.9)
    )
    assert below.mean() > 1e-4
    assert far.max() == 0


def test_horizons_of_convex_surfaces_let_low_light_in(tmp_path: Path) -> None:
    """Through the whole shading: single scattering."""
    write_material(tmp_path, model="relief", finest=3)
    stored = read_material(tmp_path)
    evaluator, shade = Evaluator(stored), next(op for op in stored.operations if isinstance(op, Shade))
    u = mi.Point2f(np.random.default_rng(0).random((2, 200)).astype(np.float32))
    values = evaluator.stage1(u, mi.Float(2.0), mi.Vector3f(0.0, 0.6, 0.8))
    light, found = lit_from(0.15, 0.0).omega_i, []
    for kappa in (-1.0, 0.0, 1.0):
        lit = lit_from(0.15, kappa, -0.1, DEPTH, places=4)
        core = evaluator.stage2(values, light, lit)[shade.output][3:6]
        found.append(np.mean([np.array(c).mean() for c in core]))
    assert found[0] < 0.9 * found[1] < 0.81 * found[2]


def test_shadow_rays_are_those_of_a_plane(tmp_path: Path) -> None:
    """Curved surfaces keep their horizons. A quarter of the lanes is flat."""
    u = mi.Point2f(np.random.default_rng(0).random((2, 400)).astype(np.float32))
    flat = mi.Bool(np.arange(400) % 4 == 0)
    lit = replace(lit_from(0.1, 0.5, -0.1, DEPTH, places=4), flat=flat)
    found = []
    for shadow_rays in (False, True):
        relief = {"places": 4, "shadow_rays": shadow_rays}
        folder = tmp_path / str(shadow_rays)
        write_material(folder, model="relief", finest=3, network={"relief": relief})
        stored = read_material(folder)
        evaluator, shade = Evaluator(stored), next(op for op in stored.operations if isinstance(op, Shade))
        values = evaluator.stage1(u, mi.Float(3.0), mi.Vector3f(0.0, 0.6, 0.8))
        found.append(np.array(evaluator.stage2(values, lit.omega_i, lit)[shade.output][0]))
    np.testing.assert_array_equal(found[0][~np.array(flat)], found[1][~np.array(flat)])
    assert np.abs(found[0] - found[1])[np.array(flat)].mean() > 0.01


def test_light_from_below_the_plane(tmp_path: Path) -> None:
    """It reaches nothing below all horizons, and above them, less of what others scatter than the network
    says, which saw no such light."""
    found = {}
    for brightness in (0.3, 3.0):
        write_material(tmp_path / str(brightness), model="relief", finest=3, brightness=brightness)
        evaluator = Evaluator(read_material(tmp_path / str(brightness)))
        values = evaluator.stage1(mi.Point2f(0.2, 0.7), mi.Float(2.0), mi.Vector3f(0.0, 0.6, 0.8))
        lowest = mi.Vector3f(float(np.sqrt(0.99)), 0.0, 0.1)
        for z, bend in ((-0.01, 0.0), (-0.5, 0.5), (-0.2, 0.5), (-0.1, 0.5), (0.1, 0.5)):
            value = evaluator.value(values, lowest, lit_from(z, bend))
            found[brightness, z] = np.array(value).mean()
    scattered = [found[3.0, z] - found[0.3, z] for z in (-0.01, -0.5, -0.2, -0.1, 0.1)]
    assert scattered[:2] == [0, 0]
    assert found[3.0, -0.01] == found[3.0, -0.5] == 0
    assert 0 < scattered[2] < scattered[3] < scattered[4]

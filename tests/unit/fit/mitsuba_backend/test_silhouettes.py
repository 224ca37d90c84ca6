"""Curvature of surfaces, and view rays in the shell of heights over them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from support.known_surfaces import geometry, heights_at, rough_heights
from support.plugin_materials import write_material
from support.plugin_scenes import plane
from support.scenes import mi

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import UsageError
from mbtf_fit.backends.mitsuba import load_scene
from mbtf_fit.backends.mitsuba.arcs import Arc, trace_arcs
from mbtf_fit.backends.mitsuba.curvature import curvature, in_axes, with_normal_partials
from mbtf_fit.backends.mitsuba.frame import tilted
from mbtf_fit.material.transmittance import Transmittance
from mbtf_fit.surface.known import KnownSurface
from mbtf_gen.pictures.shapes import Chart
from mbtf_gen.tile.tracers.heightfield import HeightField

F64 = NDArray[np.float64]
DEPTH = 0.25


def hits(scene: Any, n: int = 64, seed: int = 0) -> Any:
    """Hits of parallel rays on a shape around the origin."""
    random = np.random.default_rng(seed).uniform(-0.6, 0.6, (2, n)).astype(np.float32)
    origin = mi.Point3f(-20.0, mi.Float(random[0]), mi.Float(random[1]))
    return scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(1, 0, 0)))


@pytest.mark.parametrize(
    ("shape", "principal"),
    [
        ({"type": "sphere", "radius": 2.0}, (0.5, 0.5)),
        ({"type": "sphere", "radius": 2.0, "flip_normals": True}, (-0.5, -0.5)),
        ({"type": "cylinder", "radius": 2.0, "p0": [0, 0, -1], "p1": [0, 0, 1]}, (0.0, 0.5)),
        ("mesh", (2 * np.pi / 13, 2 * np.pi / 13)),
        ({"type": "rectangle", "to_world": [0, 1, 0]}, (0.0, 0.0)),
    ],
)
def test_curvature_is_that_of_the_shape(shape: Any, principal: tuple[float, float]) -> None:
    """Principal curvatures."""
    if shape == "mesh":
        shape = Chart("sphere", 13, 1.0).mesh(None, {"type": "diffuse"}, 16)
    elif shape["type"] == "rectangle":
        shape = shape | {"to_world": mi.ScalarTransform4f().rotate([0, 1, 0], -90)}
    scene = mi.load_dict({"type": "scene", "shape": shape})
    si = with_normal_partials(hits(scene))
    xx, xy, yy = (np.array(x) for x in curvature(si, mi.Float(1.0)))
    matrices = np.moveaxis(np.array([[xx, xy], [xy, yy]]), -1, 0)
    np.testing.assert_allclose(np.linalg.eigvalsh(matrices), np.tile(sorted(principal), (64, 1)), atol=0.01)


def test_the_form_is_that_of_the_frame() -> None:
    axes, form = np.array([[1.3, 0.2], [-0.4, -0.9]]), np.array([[0.3, -0.2], [-0.2, 0.9]])
    found = in_axes((mi.Float(0.3), mi.Float(-0.2), mi.Float(0.9)), *(mi.Vector2f(axis) for axis in axes))
    expected = (axes @ form @ axes.T)[[0, 0, 1], [0, 1, 1]]
    np.testing.assert_allclose(np.array(found).ravel(), expected, atol=1e-6)


def test_tilting_back_is_the_inverse() -> None:
    w = np.random.default_rng(0).standard_normal((3, 50))
    w /= np.linalg.norm(w, axis=0)
    tilt = mi.Vector2f(0.3, -0.5)
    there = tilted(mi.Vector3f(w.astype(np.float32)), tilt)
    np.testing.assert_allclose(np.array(tilted(there, tilt, back=True)), w, atol=1e-6)
    normal = np.array(tilted(mi.Vector3f(0, 0, 1), tilt, back=True)).ravel()
    angle = np.hypot(0.3, 0.5)
    np.testing.assert_allclose(
        normal, [*np.array([0.3, -0.5]) / angle * np.sin(angle), np.cos(angle)], atol=1e-6
    )


@pytest.mark.parametrize(("kappa", "plateau"), [(0.2, False), (1.0, False), (-0.5, False), (1.0, True)])
def test_rays_over_a_sphere_meet_what_small_steps_find(kappa: float, plateau: bool) -> None:
    """View rays from the top of the shell, stepped over the sphere. Those that graze a plateau dip between
    the borders of large blocks."""
    n, steps, random = 300, 8000, np.random.default_rng(3)
    z = rough_heights(16, 16, DEPTH).astype(np.float64)
    if plateau:
        z[:], z[0, 0] = -0.1, -DEPTH
    heightfield = HeightField.of(z, 1.0, 1.0, False)
    z = z[::-1]
    up, azimuth = -random.uniform(0.05, 0.95, n), random.uniform(0, 2 * np.pi, n)
    flat, (u, v) = np.sqrt(1 - up**2), random.random((2, n))
    d = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up])
    form = mi.Vector3f(kappa, 0.0, kappa)
    arc = Arc.of(mi.Vector3f(d.astype(np.float32)), form, mi.Float(DEPTH), 64.0)
    places = [mi.Point2f(u, v), mi.Point2f(v, u)]
    (single,), (other,) = (trace_arcs(heightfield, [place], arc, 1.0, mi.Bool(True)) for place in places)
    # Places that are traced together do not mix.
    both = trace_arcs(heightfield, places, arc, 1.0, mi.Bool(True))
    np.testing.assert_array_equal(np.array(both), np.array([single, other]))
    hit, s, height = np.array(single)
    hit = hit.astype(bool)
    # From the center of the sphere: along the normal of the start, and along the azimuth.
    radius = 1.0 / kappa
    t = np.linspace(0, 1, steps + 1)[1:, None] * 4.0
    along, across = radius + t * up, t * flat
    r = np.sign(kappa) * np.hypot(along, across)
    position = radius * np.arctan2(np.sign(kappa) * across, np.sign(kappa) * along)
    ground = heights_at(z, u + position * np.cos(azimuth), v + position * np.sin(azimuth))
    below = r - radius <= ground
    gone = np.logical_or.accumulate(r - radius > 1e-9, axis=0)
    expected = (below & ~gone).any(0)
    first = np.argmax(below & ~gone, axis=0)
    assert np.mean(hit == expected) > 0.99
    both = hit & expected
    assert both.mean() > 0.1
    lanes = np.arange(n)
    for found, exact in ((s, position), (height, r - radius)):
        assert np.quantile(np.abs(found - exact[first, lanes])[both], 0.95) < 3e-3


TURN = np.array([[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]])


def sunken(folder: Path, depth: float, aspect: float = 1.0) -> dict[str, Any]:
    """A material whose heights are all at the bottom."""
    lattice = Lattice(5, aspect)
    heights = np.full(lattice.shape(), -depth, np.float32)
    known = KnownSurface.of(geometry(lattice, heights, color=(0.5,) * 3), lattice, 0.0)
    write_material(folder, model="relief", finest=5, aspect=aspect, constant=(0.1,) * 3, known=known)
    return {"type": "mbtf", "material": str(folder), "silhouettes": True}


@pytest.mark.parametrize(
    ("turn", "scale", "aspect", "width"),
    [
        (np.eye(2), (1.0, 1.0), 1.0, 1.0),
        (np.eye(2), (2.0, 2.0), 1.0, 0.5),
        (TURN, (2.0, 8.0), 0.5, 1.0),
        (TURN @ np.diag([-1.0, 1.0]), (3.0, 3.0), 1.0, 1.0),
        (TURN @ np.array([[1.2, 0.4], [0.3, 1.1 / 1.2]]) / np.sqrt(0.98), (1.0, 1.0), 1.0, 1.0),
    ],
)
def test_rays_meet_the_bottom_over_a_cylinder(
    turn: F64, scale: Any, aspect: float, width: float, tmp_path: Path
) -> None:
    """They are a cylinder inside: places, normals, and rays that pass, under any texture coordinates and
    width of the tile, from before and behind."""
    depth, chart = 0.1, Chart("cylinder", 6, 1.0)
    material = sunken(tmp_path, depth / width, aspect) | {"uv_scale": f"{scale[0]},{scale[1]}"}
    mesh = chart.mesh(None, material, 32)
    parameters = mi.traverse(mesh)
    flat = np.array(parameters["vertex_texcoords"]).reshape(-1, 2) * [1.0, -1.0] + [0.0, 1.0]
    parameters["vertex_texcoords"] = ((flat @ turn.T) / scale / width).astype(np.float32).ravel()
    parameters.update()
    scene = load_scene({"type": "scene", "mesh": mesh})
    n, random = 2000, np.random.default_rng(4)
    radius, aim = chart.radius, random.uniform(-0.98, 0.98, 2000)
    d = np.array([[0.9], [0.0], [0.43589]]) * np.ones(n)
    origin = np.array([[-9.0], [0.0], [-4.5]]) + np.array([0 * aim, radius * aim, 0 * aim])
    ray = mi.Ray3f(*(mi.Vector3f(x.astype(np.float32)) for x in (origin, d)))
    si = scene.ray_intersect(ray)
    view = mesh.bsdf()._view(si)
    inside = np.abs(radius * aim) < radius - depth
    assert np.mean((np.array(view.hit.share) > 0.5) == inside) > 0.98
    missed = np.array(view.hit.share) == 0
    for mode in (mi.TransportMode.Radiance, mi.TransportMode.Importance):
        value = np.array(mesh.bsdf().eval(mi.BSDFContext(mode), si, mi.Vector3f(0, 0, 1))).max(0)
        np.testing.assert_array_equal(value == 0, missed)
    # Where the ray meets the cylinder inside, away from its outline.
    clear = np.abs(aim) < 0.8
    t = (9.0 - np.sqrt(np.maximum((radius - depth) ** 2 - origin[1] ** 2, 0.0))) / 0.9
    x, y, z = (origin + t * d)[:, clear]
    places = (
        np.array(view.hit.values[mesh.bsdf().shell.op.hits])[:, clear].reshape(-1, 2, clear.sum()).mean(0)
    )
    there = turn @ np.array([np.mod(np.arctan2(y, x), 2 * np.pi) * radius, z])
    off = places * [[1.0], [aspect]] - (there / width * [[1.0], [-1.0]] + [[0.0], [aspect]])
    period = np.array([[1.0], [aspect]])
    assert np.abs(off - period * np.round(off / period)).max() < 0.02
    normal = np.array(si.to_world(view.frame.to_local(mi.Vector3f(0, 0, 1))))[:, clear]
    np.testing.assert_allclose(normal, np.array([x, y, 0 * x]) / (radius - depth), atol=0.02)
    # The ray leaves the shape where it has missed the bottom, and not from far below.
    out = scene.ray_intersect(si.spawn_ray(ray.d))
    passed = np.array(out.bsdf().eval_null_transmission(out))[0]
    assert passed[~inside].mean() > 0.98
    assert passed[np.abs(aim) < 0.87].max() == 0
    # One that comes from afar, as behind an open sheet, meets the sheet.
    out.t = 1e3
    assert np.array(out.bsdf().eval_null_transmission(out)).max() == 0


@pytest.mark.parametrize("kappa", [2.0, 1e-5, -1.0])
def test_arcs_end_where_rays_over_a_sphere_do(kappa: float) -> None:
    """Also beyond a quarter of the sphere."""
    c, up = np.linspace(0.05, 0.95, 19), np.zeros(19)
    d = mi.Vector3f(np.stack([np.sqrt(1 - c**2), up, -c]).astype(np.float32))
    arc = Arc.of(d, mi.Vector3f(kappa, 0.0, kappa), mi.Float(DEPTH), 64.0)
    # Where κ t² - 2 c t + 2 D - κ D² = 0, else at the top.
    root = np.sqrt((c**2 - kappa * (2 * DEPTH - kappa * DEPTH**2)).astype(complex))
    passes = root.imag != 0
    t = np.where(passes, 2 * c / kappa, (2 * DEPTH - kappa * DEPTH**2) / (c + root.real))
    expected = np.arctan2(kappa * t * np.sqrt(1 - c**2), 1 - kappa * t * c) / kappa
    np.testing.assert_allclose(np.array(arc.end), expected, rtol=1e-4)
    for share in (1e-3, 0.5, 1.0):
        along, across = 1 / kappa - share * t * c, share * t * np.sqrt(1 - c**2)
        place = np.arctan2(kappa * across, kappa * along) / kappa
        z = np.sign(kappa) * np.hypot(along, across) - 1 / kappa
        np.testing.assert_allclose(
            np.array(arc.height(mi.Float(place.astype(np.float32)))), z, rtol=1e-4, atol=2e-5
        )


@pytest.mark.parametrize("scale", ["1, 1", "4, 0.25", "0.25, 4"])
def test_sharp_edges_are_rounded(scale: str, tmp_path: Path) -> None:
    """To 1.25 times the depth of the shell, along its steps and on the surface."""
    bsdf = mi.load_dict(sunken(tmp_path, 0.1) | {"uv_scale": scale, "sigma": 0.1})
    cylinder = {"type": "cylinder", "radius": 0.02, "p0": [0, 0, -1], "p1": [0, 0, 1]}
    scene = mi.load_dict({"type": "scene", "shape": cylinder})
    view = bsdf._view(scene.ray_intersect(mi.Ray3f(mi.Point3f(-2.0, 0.01, 0.3), mi.Vector3f(1, 0, 0))))
    form = np.array(view.hit.curvature).ravel()[[0, 1, 1, 2]].reshape(2, 2)
    steps = np.stack([np.array(view.frame.x).ravel(), np.array(view.frame.y).ravel()], 1)
    inverse = np.linalg.inv(steps)
    for curved in (form, inverse.T @ form @ inverse):
        assert 0.001 < 0.1 * np.abs(np.linalg.eigvalsh(curved)).max() < 0.801


def test_outlines_of_coarse_meshes_have_no_specks(tmp_path: Path) -> None:
    """Where the shading normal of a facet that is seen from its front faces away, rays pass, however far
    they come."""
    mesh = Chart("sphere", 6, 1.0).mesh(None, sunken(tmp_path, 0.1), 1)
    scene = load_scene({"type": "scene", "mesh": mesh})
    y, z = np.random.default_rng(5).uniform(-1.0, 1.0, (2, 20_000)).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(-90.0, mi.Float(y), mi.Float(z) - 43.589), mi.Vector3f(0.9, 0.0, 0.43589))
    si = scene.ray_intersect(ray)
    away = np.array((dr.dot(si.n, -ray.d) > 0) & (si.wi.z < 0) & si.is_valid())
    assert away.sum() > 20
    assert np.array(si.bsdf().eval_null_transmission(si))[0][away].min() == 1


def test_the_shadow_is_that_of_the_heights(tmp_path: Path) -> None:
    """Of the cylinder inside, on a wall."""
    chart, turned = Chart("cylinder", 6, 1.0), mi.ScalarTransform4f()
    wall = turned.translate([4, 0, 0]).rotate([0, 1, 0], -90).scale(9.0)
    sensor = {
        "type": "orthographic",
        "to_world": turned.look_at([2, 0, 0], [4, 0, 0], [0, 0, 1]).scale([1.2, 1.2, 1.0]),
        "film": {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgb"},
    }
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    scene = load_scene(
        {
            "type": "scene",
            "sensor": sensor,
            "mesh": chart.mesh(None, sunken(tmp_path, 0.1), 32),
            "wall": {"type": "rectangle", "to_world": wall, "bsdf": white},
            "light": {"type": "directional", "direction": [1, 0, 0], "irradiance": 1.0},
        }
    )
    picture = mi.render(scene, integrator=mi.load_dict({"type": "mbtf_path", "max_depth": 2}), spp=64)
    lit = 1.0 - (chart.radius - 0.1) / 1.2
    assert np.pi * float(np.array(picture).mean()) == pytest.approx(lit, abs=0.02)


def holes(coefficient: float) -> Transmittance:
    """Holes that are seen differently from all sides."""
    levels = [np.full((2**k, 2**k, 6), coefficient, np.float32) for k in range(4)]
    return Transmittance(Lattice(3), (0.0,), [levels])


@pytest.mark.parametrize("sampling", ["network", "cosine"])
def test_samples_are_those_of_value_and_density(sampling: str, tmp_path: Path) -> None:
    """Where some rays miss the heights, and others pass holes."""
    two = {"relief": {"places": 2}}
    write_material(tmp_path, model="relief", network=two, finest=3, transmittance=holes(0.2))
    bsdf = {
        "type": "mbtf",
        "material": str(tmp_path),
        "silhouettes": True,
        "sampling": sampling,
        "sigma": 0.2,
    }
    mesh = Chart("sphere", 8, 1.0).mesh(None, bsdf)
    scene = load_scene({"type": "scene", "mesh": mesh})
    aim = np.random.default_rng(5).uniform(0.75, 1.0, 40000).astype(np.float32) * (4 / np.pi)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(-9.0, mi.Float(aim), 0.1), mi.Vector3f(1, 0, 0)))
    material, context, random = si.bsdf(), mi.BSDFContext(), mi.PCG32(40000)
    numbers = [random.next_float32() for _ in range(5)]
    through = material.eval_null_transmission(si).x
    hit = mesh.bsdf()._view(si).hit
    # Of two rays one alone meets the heights.
    alone = np.array(hit.share) == 0.5
    assert alone.any()
    places = np.array(hit.values[mesh.bsdf().shell.op.hits])[:, alone].reshape(2, 2, -1)
    np.testing.assert_array_equal(*places)
    sample, weight = material.sample(context, si, numbers[0], mi.Point2f(*numbers[1:3]))
    null = np.array(mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null))
    reflected = ~null & (np.array(sample.pdf) > 0)
    value, pdf = material.eval_pdf(context, si, sample.wo)
    np.testing.assert_allclose(np.array(sample.pdf)[reflected], np.array(pdf)[reflected], rtol=2e-3)
    expected, found = (np.array(x)[:, reflected] for x in (value, weight * sample.pdf))
    np.testing.assert_allclose(found, expected, rtol=2e-2, atol=1e-3 * expected.max())
    assert null.mean() == pytest.approx(float(dr.mean(through)[0]), abs=0.01)
    around = mi.warp.square_to_uniform_sphere(mi.Point2f(*numbers[3:]))
    density = 4 * np.pi * np.array(material.pdf(context, si, around))
    error = density.std() / np.sqrt(density.size)
    assert reflected.mean() == pytest.approx(density.mean(), abs=4 * error + 0.01)


def test_a_plane_looks_as_without_silhouettes(tmp_path: Path) -> None:
    """Holes from both sides; rays to the light."""
    relief = {"relief": {"places": 4, "shadow_rays": True}}
    write_material(tmp_path, model="relief", network=relief, finest=3, transmittance=holes(0.1))
    found, passed = [], []
    for silhouettes in (False, True):
        bsdf = {"type": "mbtf", "material": str(tmp_path), "silhouettes": silhouettes}
        scene = load_scene({"type": "scene", "plane": plane(bsdf)})
        random = np.random.default_rng(1).uniform(-1, 1, (5, 4000)).astype(np.float32)
        towards = mi.Vector3f(mi.Float(random[0]), mi.Float(random[1]), mi.Float(0.05 + abs(random[2])))
        ray = mi.Ray3f(mi.Point3f(mi.Float(random[3]), mi.Float(random[4]), 0.0) + towards, -towards)
        si = scene.ray_intersect(ray)
        wo = mi.warp.square_to_uniform_hemisphere(0.5 * mi.Point2f(random[:2]) + 0.5)
        value, pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, wo)
        back = scene.ray_intersect(mi.Ray3f(ray.o - 2 * towards, towards))
        passed.append([np.array(si.bsdf().eval_null_transmission(x))[0] for x in (si, back)])
        found.append((np.array(value), np.array(pdf)))
    assert found[0][0].max() > 0
    for flat, curved in zip(*found, strict=True):
        np.testing.assert_allclose(flat, curved, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(*passed, atol=1e-6)
    assert 0 < np.mean(passed) < 1


def test_a_material_without_heights_has_no_silhouettes(tmp_path: Path) -> None:
    write_material(tmp_path, model="neumip", finest=2)
    with pytest.raises(UsageError, match="knows no heights"):
        load_scene({"type": "mbtf", "material": str(tmp_path), "silhouettes": True})
    with pytest.raises(UsageError, match="must be a valid boolean"):
        load_scene({"type": "mbtf", "material": str(tmp_path), "silhouettes": "some"})
    with pytest.raises(UsageError, match="both silhouettes and two_sided"):
        load_scene({"type": "mbtf", "material": str(tmp_path), "silhouettes": True, "two_sided": True})


@pytest.mark.parametrize("integrator", ["path", "mbtf_path"])
def test_a_flat_tile_in_a_furnace_keeps_its_energy(integrator: str, tmp_path: Path) -> None:
    """On a sphere it is opaque, and as bright as on a plane."""
    write_material(tmp_path, model="relief", constant=(0.2,) * 3, finest=2)
    bsdf = {"type": "mbtf", "material": str(tmp_path), "uv_scale": 8.0, "silhouettes": True}
    sensor = {
        "type": "perspective",
        "fov": 20,
        "to_world": mi.ScalarTransform4f().look_at([0, -4, 1], [0, 0, 0], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgb"},
    }
    ball = {"type": "sphere", "bsdf": bsdf}
    scene = mi.load_dict({"type": "scene", "s": sensor, "b": ball, "e": {"type": "constant"}})
    picture = mi.render(scene, integrator=mi.load_dict({"type": integrator, "max_depth": 6}), spp=128)
    assert float(np.array(picture).mean()) == pytest.approx(0.2 * np.pi, rel=0.005)

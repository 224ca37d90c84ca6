"""A plane with a fitted material in a Mitsuba scene shows what the material answers at the same queries."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file
from support.plugin_materials import deviation, net, replace_tensors, write_material
from support.plugin_scenes import interaction, plane, sensor_of, through_pixel_centers
from support.scenes import directional, mi

from mbtf_core.data.lattice import Lattice
from mbtf_core.directions import from_angles
from mbtf_core.errors import InputError, MbtfError, UsageError
from mbtf_core.pictures import Camera
from mbtf_fit import Material
from mbtf_fit.backends.mitsuba import load_scene
from mbtf_fit.backends.mitsuba.partials import set_uv_partials, uv_partials
from mbtf_fit.material.transmittance import Transmittance

LIGHT = from_angles(40.0, 20.0)
# A narrow view: differentials, which the footprint comes from, are differences over a pixel.
CAMERA = Camera(50.0, -70.0, tiles_across=1.3, target=(0.3, 0.6), rows=24, columns=32, field_of_view=8.0)


@pytest.fixture(scope="module")
def material(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Material]:
    folder, model = tmp_path_factory.mktemp("material"), getattr(request, "param", "neumip")
    return folder, write_material(folder, model=model, aspect=1.5, finest=4, contrast=0.2, brightness=0.5)


BOTH_MODELS = pytest.mark.parametrize("material", ["neumip", "relief"], indirect=True)


def bsdf(folder: Path, **options: Any) -> dict[str, Any]:
    """The plugin with the cheapest of settings to compile."""
    fast = {"sampling": "cosine", "networks": "cooperative"}
    return {"type": "mbtf", "material": str(folder), **fast, **options}


def cones() -> Any:
    """With round footprints, as those of queries."""
    return mi.load_dict({"type": "mbtf_path", "max_depth": 2, "max_anisotropy": 1})


def lit(mesh: Any, sensor: Any, light: Any = LIGHT, **more: Any) -> Any:
    return mi.load_dict({"type": "scene", "m": mesh, "e": directional(light), "sensor": sensor, **more})


def shown(mesh: Any, camera: Camera = CAMERA, light: Any = LIGHT) -> np.ndarray:
    """What ``mbtf_path`` sees of a plane through the pixels' centers, under unit irradiance."""
    return through_pixel_centers(lit(mesh, sensor_of(camera), light), camera, cones())


@BOTH_MODELS
@pytest.mark.parametrize("zoom", [0.5, 1.0, 8.0, 64.0])
def test_a_plane_equals_the_material_at_its_pixels(material: tuple[Path, Material], zoom: float) -> None:
    """Positions, footprints, directions, orientation of the tile: all of them, at all distances."""
    folder, fitted = material
    camera = Camera(**{**CAMERA.__dict__, "tiles_across": CAMERA.tiles_across * zoom})
    wanted = fitted.predict(camera.queries(LIGHT, fitted.lattice.aspect).flat())  # type: ignore[arg-type]
    found = shown(plane(bsdf(folder), aspect=fitted.lattice.aspect), camera)
    assert wanted.std() > 0.03 * wanted.mean()
    assert deviation(found.reshape(-1, 3), wanted) < 4e-3


ROTATION = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(
    ("material", "scale"),
    [("neumip", (1.0, 1.0)), ("neumip", (2.5, 1.5)), ("relief", (1.0, 1.0)), ("relief", (2.0, 2.0))],
    indirect=["material"],
)
def test_the_tile_follows_its_uv(
    material: tuple[Path, Material], mirrored: bool, scale: tuple[float, float]
) -> None:
    """Turned, mirrored and scaled coordinates: the plane equals the material at such queries, whose
    directions are stretched as the tile is (and known facets are not: test_stretched_tiles)."""
    folder, fitted = material
    turn = ROTATION @ np.diag([1.0, -1.0 if mirrored else 1.0])
    to_uv = np.concatenate([np.diag([1.0, -1.0]) @ turn, [[0.0], [1.0]]], 1)
    queries = CAMERA.queries(LIGHT)
    # Mitsuba's v is 1 - y here, and is scaled about 0.
    x, y = np.moveaxis(seen_places(CAMERA) @ turn.T, -1, 0)
    u = np.stack([scale[0] * x, 1.0 - scale[1] * (1.0 - y) / fitted.lattice.aspect], -1)
    stretched = np.array(scale)[:, None] * turn / math.sqrt(scale[0] * scale[1])
    turned = [
        np.concatenate([w[..., :2] @ stretched.T, w[..., 2:]], -1) for w in (queries.omega_i, queries.omega_o)
    ]
    turned = [w / np.linalg.norm(w, axis=-1, keepdims=True) for w in turned]
    arrays = (u, math.sqrt(scale[0] * scale[1]) * queries.sigma, *turned)
    wanted = fitted.evaluate(*(a.reshape(-1, *a.shape[2:]) for a in arrays))
    found = shown(plane(bsdf(folder, uv_scale=f"{scale[0]}, {scale[1]}"), to_uv)).reshape(-1, 3)
    assert deviation(found, wanted) < 2e-2


def seen_places(camera: Camera) -> np.ndarray:
    """(x, y) on the plane that the pixels' centers see, not wrapped."""
    forward, right, up = camera.frame()
    x = (np.arange(camera.columns) + 0.5 - camera.columns / 2) * camera.pixel_pitch
    y = (camera.rows / 2 - np.arange(camera.rows) - 0.5) * camera.pixel_pitch
    ray = forward + x[None, :, None] * right + y[:, None, None] * up
    return (camera.position + ray * (camera.position[2] / -ray[..., 2:]))[..., :2]


def write_levels(folder: Path) -> Material:
    """Levels of different constant features: brightness depends on σ."""
    levels = {f"pyramid.{s}": torch.full((2**s, 2**s, 7), 0.5 * s) for s in range(5)}
    return write_material(folder, model="neumip-baseline", finest=4, weights=levels)


def test_samples_share_the_footprint_of_a_pixel(tmp_path: Path) -> None:
    """16 samples of a pixel stand for a sixteenth of its area each: a picture is not blurred twice."""
    fitted = write_levels(tmp_path)
    camera = Camera(elevation=70.0, tiles_across=3.0, rows=8, columns=8)
    q = camera.queries(LIGHT).flat()
    whole, shared = (fitted.evaluate(q.u, s * q.sigma, q.omega_i, q.omega_o).mean() for s in (1.0, 0.25))
    scene = lit(plane(bsdf(tmp_path)), sensor_of(camera, 16))
    found = np.array(mi.render(scene, integrator=cones(), spp=16)).mean()
    assert abs(shared / whole - 1) > 0.05
    assert found == pytest.approx(shared, rel=5e-3)


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_holes_do_not_change_the_cone(tmp_path: Path, share: float) -> None:
    """The cone passes a transparent sheet unchanged: a plane whose brightness depends on σ looks the same."""
    fitted = write_levels(tmp_path / "plane")
    texel = np.zeros((1, 1, 6), np.float32)
    texel[..., 0] = 1.0
    hole = Transmittance(Lattice(0), (0.0,), [[texel]])
    write_material(tmp_path / "sheet", finest=0, constant=(0.0,) * 3, transmittance=hole)
    camera = Camera(elevation=55.0, tiles_across=3.0, rows=6, columns=6)
    at = mi.ScalarTransform4f().translate([0, 0, share * float(camera.position[2])]).scale(300.0)
    sheet = {"type": "rectangle", "to_world": at, "b": bsdf(tmp_path / "sheet")}
    tracer = mi.load_dict({"type": "mbtf_path", "max_depth": 3, "max_anisotropy": 1})
    mesh, sensor = plane(bsdf(tmp_path / "plane")), sensor_of(camera)
    scenes = lit(mesh, sensor), lit(mesh, sensor, s=sheet)
    bare, behind = (through_pixel_centers(scene, camera, tracer) for scene in scenes)
    bare, behind = bare[..., 0], behind[..., 0]
    q = camera.queries(LIGHT).flat()
    narrower, wider = (
        fitted.evaluate(q.u, f * q.sigma, q.omega_i, q.omega_o)[:, 0].mean() for f in (0.9, 1.1)
    )
    assert min(abs(x / bare.mean() - 1) for x in (narrower, wider)) > 0.01
    np.testing.assert_allclose(behind, bare, rtol=2e-3)


def test_other_integrators_use_the_given_footprint(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    fitted = write_material(tmp_path, finest=4, contrast=0.2, brightness=0.5)
    queries = CAMERA.queries(LIGHT).flat()
    unmodified = mi.load_dict({"type": "path", "max_depth": 2})
    for given, sigma in (({"sigma": 0.1}, 0.1), ({}, fitted.lattice.sigma_range[0])):
        wanted = fitted.evaluate(
            queries.u, np.full_like(queries.sigma, sigma), queries.omega_i, queries.omega_o
        )
        caplog.clear()
        for _ in range(2):
            scene = lit(plane(bsdf(tmp_path, **given)), sensor_of(CAMERA))
            with caplog.at_level(logging.WARNING, logger="mbtf_fit"):
                found = through_pixel_centers(scene, CAMERA, unmodified).reshape(-1, 3)
        assert deviation(found, wanted) < 4e-3
        assert len([r for r in caplog.records if "mbtf_path" in r.message]) == (0 if given else 1)


def test_footprints_of_mitsuba_are_used(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Here of a surface that is seen at 60°."""

    class Hit(mi.SurfaceInteraction3f):  # type: ignore[misc]
        """One of Mitsuba 3.10."""

    fitted, tilted = write_material(tmp_path, finest=4, contrast=0.2, brightness=0.5), 30.0
    width, turn = 0.05, np.radians(tilted)
    sides = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) * [2 * width, width]
    hits = interaction(1, (0.3, 0.2, 0.9), dp_du=mi.Vector3f(1, 0, 0), dp_dv=mi.Vector3f(0, -1, 0))
    hit, light = Hit(hits), from_angles(50.0, 30.0)
    hit.footprint = mi.Matrix2f(sides)
    with caplog.at_level(logging.WARNING, logger="mbtf_fit"):
        found = np.array(
            mi.load_dict(bsdf(tmp_path)).eval(mi.BSDFContext(), hit, mi.Vector3f(*light.tolist()))
        ).T
    # The Gaussian of a pixel has half its width.
    viewer, sigma = np.array(hits.wi).T, [0.5 * width * np.sqrt(2.0)]
    wanted = fitted.evaluate(np.array([[0.0, 1.0]]), np.array(sigma), light[None], viewer)
    assert deviation(found / light[2], wanted) < 1e-4
    assert not caplog.records
    set_uv_partials(hit, *uv_partials(hit))
    np.testing.assert_allclose(np.array(hit.footprint)[..., 0], sides, rtol=1e-5)


def test_scenes_are_asked_for_footprints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a texture among the objects that a scene finds, where textures may be filtered."""
    write_material(tmp_path, finest=2)
    scene = lit(plane(bsdf(tmp_path)), sensor_of(CAMERA))
    names = mi.traverse(scene).keys()
    monkeypatch.setattr(mi.Texture, "filtered", lambda texture: False, raising=False)
    asked = mi.traverse(scene)
    assert any(node.filtered() for node in asked.hierarchy if isinstance(node, mi.Texture))
    assert asked.keys() == names


@BOTH_MODELS
def test_nothing_is_seen_from_below_or_lit_from_below(material: tuple[Path, Material]) -> None:
    below = from_angles(-40.0, 20.0)
    mesh = plane(bsdf(material[0]))
    assert shown(mesh).mean() > 0.02
    assert shown(mesh, light=below).max() == 0
    under = Camera(**{**CAMERA.__dict__, "elevation": -50.0})
    assert shown(mesh, under, below).max() == shown(mesh, under, LIGHT).max() == 0
    both = plane({"type": "twosided", "bsdf": bsdf(material[0])})
    seen = shown(both, under, below)
    assert seen.mean() > 0.02
    np.testing.assert_allclose(shown(plane(bsdf(material[0], two_sided=True)), under, below), seen, rtol=1e-4)


@pytest.mark.parametrize("min_cos", [None, 0.02, 0.3])
def test_directions_below_the_data_are_raised_to_their_edge(min_cos: float | None, tmp_path: Path) -> None:
    """The edge is that of the data set which the material was fitted to; 0.1 where none is stated."""
    stated = {} if min_cos is None else {"min_cos": min_cos}
    with_z = net(encoding={"direction_xyz": True})
    fitted = write_material(tmp_path, contrast=0.2, brightness=0.5, **with_z, **stated)
    edge = 0.1 if min_cos is None else min_cos
    cosine = np.array([0.01, 0.05, 0.15, 0.4])
    azimuth = np.linspace(0.3, 5.0, len(cosine))

    def towards(z: np.ndarray) -> np.ndarray:
        sine = np.sqrt(1 - z * z)
        return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), z], -1)

    plugin = mi.load_dict(bsdf(tmp_path, sigma=0.1))
    hits = interaction(len(cosine), (0.3, 0.2, 0.9), dp_du=mi.Vector3f(1, 0, 0), dp_dv=mi.Vector3f(0, -1, 0))
    light = mi.Vector3f(*towards(cosine).T)
    found = np.array(plugin.eval(mi.BSDFContext(), hits, light)).T / cosine[:, None]
    viewer = np.tile(np.array(hits.wi)[:, :1].T, (len(cosine), 1))
    at = np.tile([0.0, 1.0], (len(cosine), 1)), np.full(len(cosine), 0.1)
    wanted = fitted.evaluate(*at, towards(np.maximum(cosine, edge)), viewer)
    unraised = fitted.evaluate(*at, towards(cosine), viewer)
    assert deviation(found, wanted) < 1e-4
    assert deviation(unraised, wanted) > 1e-3


def scene_of(folder: Path | str, **options: Any) -> dict[str, Any]:
    material = {"type": "mbtf", "material": str(folder), **options}
    return {"type": "scene", "ball": {"type": "sphere", "b": material}}


@pytest.mark.parametrize(
    ("options", "fault", "kind"),
    [
        ({"material": "nowhere"}, "nowhere: no such folder", InputError),
        ({"uv_scale": -1.0}, "'uv_scale.0': must be greater than 0", UsageError),
        ({"networks": "exact"}, "'networks': must be 'unrolled'", UsageError),
        ({"uvscale": 4.0}, "unknown key 'uvscale'\n  did you mean 'uv_scale'?", UsageError),
    ],
)
def test_errors_of_a_scene_are_one_line(
    options: dict[str, Any], fault: str, kind: type[MbtfError], material: tuple[Path, Material]
) -> None:
    with pytest.raises(kind) as caught:
        load_scene(scene_of(material[0]) | {"ball": {"type": "sphere", "b": bsdf(material[0]) | options}})
    assert fault in caught.value.message
    assert len(caught.value.message.splitlines()) <= 2


@pytest.mark.parametrize("planted", [-3.0, np.nan, np.inf])
def test_clamped_environment_maps_are_those_with_texels_of_zero(
    planted: float, caplog: pytest.LogCaptureFixture
) -> None:
    """In value and in the density of their sampling, at every texel and between them."""
    texels = np.ones((8, 16, 3), np.float32)
    texels[2, 3] = planted
    with caplog.at_level(logging.WARNING, logger="mbtf_fit"):
        load_scene({"type": "scene", "sky": {"type": "envmap", "bitmap": mi.Bitmap(texels)}})
    assert len(caplog.records) == 1
    skies = []
    for texel, clamp in ((planted, True), (0.0, False)):
        texels = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
        texels[2, 3] = texel
        sky = {"type": "envmap", "bitmap": mi.Bitmap(texels)}
        skies.append(load_scene({"type": "scene", "sky": sky}, clamp_environment=clamp).environment())
    assert len(caplog.records) == 1
    directions = np.random.default_rng(1).normal(size=(3, 4096))
    directions /= np.linalg.norm(directions, axis=0)
    si, ds = dr.zeros(mi.SurfaceInteraction3f, 4096), dr.zeros(mi.DirectionSample3f, 4096)
    si.wi, ds.d = mi.Vector3f(-directions), mi.Vector3f(directions)
    for of in (lambda sky: sky.eval(si), lambda sky: sky.pdf_direction(si, ds)):
        clamped, zero = (np.array(of(sky)) for sky in skies)
        np.testing.assert_allclose(clamped, zero, rtol=1e-5, atol=1e-7)
        assert zero.std() > 0.01


def test_a_mesh_without_uv_is_refused(material: tuple[Path, Material], tmp_path: Path) -> None:
    path = tmp_path / "bare.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_index\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    bare = {"type": "scene", "bare": {"type": "ply", "filename": str(path), "b": bsdf(material[0])}}
    with pytest.raises(InputError, match="shape 'bare': the mesh has an mbtf material but no texture"):
        load_scene(bare)


@pytest.mark.parametrize(("model", "allowed"), [("neumip", 0), ("relief", 2)])
def test_deviations_from_conformance_values_are_refused(model: str, allowed: int, tmp_path: Path) -> None:
    """A material whose conformance values say otherwise than its weights. Few of those of `relief` may."""
    write_material(tmp_path, model=model)
    values = load_file(tmp_path / "weights.safetensors")["conformance.rgb"]
    for wrong in range(allowed + 1):
        replace_tensors(tmp_path, {"conformance.rgb": values})
        load_scene(scene_of(tmp_path, sampling="cosine", networks="cooperative"))
        values[7 + wrong] = 1.01 * values[7 + wrong] + 0.01
    replace_tensors(tmp_path, {"conformance.rgb": values})
    with pytest.raises(InputError, match="does not reproduce its conformance values"):
        load_scene(scene_of(tmp_path, sampling="cosine", networks="cooperative"))

"""What the viewer draws: shapes, frames, light from all around, two materials, and the mean of frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.browser import Page
from support.material_cases import make

from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera
from mbtf_fit.material.material import Material
from mbtf_fit.viewer.extras import mesh_content
from mbtf_fit.viewer.page import as_read, encode, material_content, pack_textures, write_page

F64 = NDArray[np.float64]
ASPECT = 0.5
# Two squares beside each other, the second one mirrored in the texture; files have y up.
SQUARES = """
v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 1 0 0\nv 2 0 0\nv 2 1 0\nv 1 1 0
vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt 2 0\nvt 2 1
vn 0 0 1
f 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1\nf 5/5/1 6/2/1 7/3/1\nf 5/5/1 7/3/1 8/6/1
"""
# A sky with one bright pixel.
SKY, SPOT, COLOR = (64, 128), (20, 13), np.array([4.0, 2.0, 1.0])
LIGHT: dict[str, Any] = {"direction": [0, 0, 1], "color": [1, 1, 1], "intensity": 1}


@pytest.fixture(scope="module")
def page(driver: Any, tmp_path_factory: pytest.TempPathFactory) -> Page:
    """Materials of aspect ½, two squares and a sky; nothing is drawn unless a test asks for it."""
    folder = tmp_path_factory.mktemp("scene")
    make("calibrated", folder / "half")
    make("relief", folder / "relief")
    (folder / "squares.obj").write_text(SQUARES)
    sky = np.zeros((*SKY, 3), np.float32)
    sky[SPOT] = COLOR
    content = {
        "materials": [material_content(folder / name)[0] for name in ("half", "relief")],
        "mesh": mesh_content(folder / "squares.obj"),
        "environment": {"name": "spot", "shape": list(SKY), "data": encode(sky)},
    }
    page = Page(driver, write_page(content, "scene"), folder).ready()
    page.js("window.mbtf.viewer.draw = () => false")
    return page


def view(elevation: float, azimuth: float, across: float, *target: float) -> dict[str, Any]:
    at = [*target, 0, 0, 0][:3]
    return {"elevation": elevation, "azimuth": azimuth, "tiles_across": across, "target": at}


def evaluate(material: Material, camera: Camera, light: F64) -> F64:
    """M of a picture under a light, as the page's textures give it."""
    q = camera.queries(light, material.lattice.aspect)
    flat = (np.asarray(a, np.float64).reshape(-1, *a.shape[2:]) for a in (q.u, q.sigma, q.omega_i, q.omega_o))
    value = as_read(material, pack_textures(material)).evaluate(*flat)
    return np.asarray(value, np.float64).reshape(camera.rows, camera.columns, 3)


def ray(page: Page, camera: Camera, x: float, y: float) -> F64:
    """Unit direction from the camera through the pixel at a place from the top left."""
    columns, rows = page.js(
        "const { canvas } = window.mbtf.viewer.renderer; return [canvas.width, canvas.height]"
    )
    forward, right, up = camera.frame()
    pitch = 2.0 * np.tan(np.radians(camera.field_of_view) / 2.0) / columns
    across, along = np.floor(x * columns) + 0.5 - columns / 2, np.floor((1 - y) * rows) + 0.5 - rows / 2
    d = forward + pitch * (across * right + along * up)
    return np.asarray(d / np.linalg.norm(d), np.float64)


@pytest.mark.parametrize(("elevation", "azimuth", "across"), [(90, -90, 0.5), (50, -90, 4), (25, 30, 90)])
@pytest.mark.parametrize("case", ["relief", "calibrated"])
def test_pictures_are_those_of_the_same_camera(
    page: Page, tmp_path: Path, case: str, elevation: float, azimuth: float, across: float
) -> None:
    """Pixel by pixel: positions, footprints, frames, orientation, and the light's cosine."""
    light, color = from_angles(40.0, 20.0), np.array([1, 0.5, 0.25])
    lights = [{"direction": light.tolist(), "color": color.tolist(), "intensity": 2}]
    material = ["calibrated", "relief"].index(case)
    page.set({"camera": view(elevation, azimuth, across, 0.5, 0.5), "lights": lights, "material": material})
    found = page.picture(24, 32)
    camera = Camera(elevation, azimuth, across, rows=24, columns=32)
    expected = evaluate(make(case, tmp_path / "material"), camera, light) * light[2] * 2.0 * color
    # Derivatives are those of 2 x 2 pixels, so levels differ a little within the pixel, and far away places.
    difference = np.abs(found[..., :3] - expected)
    assert np.median(difference) < 0.03 * expected.mean()
    assert difference.mean() < 0.08 * expected.mean()
    assert found[..., :3].mean((0, 1)) == pytest.approx(expected.mean((0, 1)), rel=0.01, abs=1e-4)
    assert (found[..., 3] == 1).all()


@pytest.mark.parametrize("azimuth", [-90, 20])
def test_round_footprints_of_the_frames_add_up_to_the_ellipse_of_a_pixel(page: Page, azimuth: float) -> None:
    """A pixel sees an ellipse of the plane, which is 1/sin of the elevation as long as wide, towards the
    camera. Its covariance is that of the places plus that of the footprints around them."""
    page.set({"camera": view(12, azimuth, 1, 0.5, 0.25), "lights": [LIGHT], "material": 0})
    code = """
        const { viewer } = window.mbtf, { renderer } = viewer, size = arguments[0], found = [];
        const target = renderer.mean("test", size, size, 1).latest;
        for (let frame = 0; frame < 65; frame++) {
            renderer._scene(viewer.material, target, viewer.scene, { shown: 1, frame }, [0, 0, size, size]);
            found.push([...target.read(0, 0, size, size)]);
        }
        return found;
    """
    size, aspect = 64, 0.5
    middle = slice(24, 40), slice(24, 40)
    found = np.array(page.js(code, size)).reshape(-1, size, size, 4)[:, ::-1]
    q = Camera(12, azimuth, 1, (0.5, 0.25), rows=size, columns=size).queries(np.array([0, 0, 1.0]), aspect)
    assert np.median(found[0, ..., 2] / q.sigma) == pytest.approx(1, abs=0.03)
    step = ((found[1:, ..., :2] - found[0, ..., :2] + 0.5) % 1 - 0.5) * (1, aspect)
    along = q.omega_o[..., :2] / np.linalg.norm(q.omega_o[..., :2], axis=-1)[..., None]
    across = np.stack([-along[..., 1], along[..., 0]], -1)
    expected = q.omega_o[..., 2] ** -1.0 * q.sigma**2, q.omega_o[..., 2] * q.sigma**2, np.zeros((size, size))
    for (a, b), variance in zip(((along, along), (across, across), (along, across)), expected, strict=True):
        places = ((step * a).sum(-1) * (step * b).sum(-1)).mean(0)
        covariance = places + (found[1, ..., 2] ** 2 if a is b else 0.0)
        # Around the center, where rays are parallel to the camera's axis.
        assert np.median((covariance - variance)[middle] / expected[1][middle]) == pytest.approx(0, abs=0.15)


@pytest.mark.parametrize("angle", [0, 90])
def test_a_bright_pixel_of_a_sky_is_a_directional_light(page: Page, angle: int) -> None:
    """Of irradiance 1 on the plane: at the azimuth of an envmap of Mitsuba, plus the rotation."""
    theta, phi = np.pi * (SPOT[0] + 0.5) / SKY[0], np.radians(90 - 360 * (SPOT[1] + 0.5) / SKY[1] + angle)
    light = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    camera, luminance = view(60, -70, 1, 0.5, 0.25), COLOR @ (0.2126, 0.7152, 0.0722)
    colored = {"color": (COLOR / 4).tolist(), "intensity": 4 / luminance * 2 / light[2]}
    page.set({"camera": camera, "lights": [{"direction": light.tolist(), **colored}]})
    expected = page.picture(24, 32)[..., :3]
    page.set({"camera": camera, "lights": []})
    for name, value in (("environment", "spot"), ("environment_intensity", 1), ("environment_angle", angle)):
        page.choose(name, value)
    found = page.picture(24, 32)[..., :3]
    assert np.abs(found - expected).mean() < 0.06 * expected.mean()
    assert found.mean((0, 1)) == pytest.approx(expected.mean((0, 1)), rel=0.02)


def test_samples_of_the_built_in_sky_follow_its_radiance(page: Page) -> None:
    """A quarter of the light comes from the sun; directions of equal radiance are uniform on the sphere."""
    page.set({"environment": {"name": "sky"}})
    code = """
        const { gl, environment } = window.mbtf.viewer.renderer, out = new Float32Array(4 * 64 * 128);
        gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
        gl.framebufferTexture2D(
            gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, environment.handle, 0);
        gl.readPixels(0, 0, 64, 128, gl.RGBA, gl.FLOAT, out);
        return [...out];
    """
    table = np.array(page.js(code)).reshape(64, 2, 64, 4)
    directions, radiance = table[:, 0, :, :3].reshape(-1, 3), table[:, 1, :, :3].reshape(-1, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-5)
    near_sun = directions @ (0.48, -0.36, 0.8) > np.cos(np.radians(12.0))
    assert 0.15 < near_sun.mean() < 0.4
    # Irradiance 1 of the plane; samples have equal luminance.
    luminance = radiance @ (0.2126, 0.7152, 0.0722)
    assert np.ptp(luminance) < 1e-3 * luminance.mean()
    assert (luminance * np.maximum(directions[:, 2], 0)).mean() == pytest.approx(1, abs=0.02)
    # Below the horizon radiance is constant, and so is the density.
    below = directions[directions[:, 2] < 0]
    assert (below[:, 2] ** 2).mean() == pytest.approx(1 / 3, abs=4 * 0.3 / np.sqrt(len(below)))


@pytest.mark.parametrize("behind", [False, True])
def test_values_on_a_mesh_have_the_frame_of_its_texture(page: Page, behind: bool) -> None:
    """A square, and one with a mirrored texture, from both sides."""
    camera = Camera(10, 110 if behind else -70, 5, (0, 0))
    page.set({"camera": view(10, camera.azimuth, 5), "shape": "squares", "tiles": 2})
    seen = set()
    for x in (0.35, 0.65):
        found = page.pick(x, 0.45)
        assert found is not None
        d, o = ray(page, camera, x, 0.45), camera.position
        p = o - o[1] / d[1] * d
        mirrored = -1 if p[0] > 0 else 1
        u = np.array([mirrored * p[0], (p[2] + 1) / ASPECT])
        assert np.abs((np.array(found["u"]) - u + 0.5) % 1 - 0.5).max() < 0.02
        assert found["omega_o"] == pytest.approx([-mirrored * d[0], -d[2], abs(d[1])], abs=0.01)
        seen.add(mirrored)
    assert len(seen) == 2


@pytest.mark.parametrize("shape", ["sphere", "cloth", "squares"])
def test_frames_of_shapes_are_the_derivatives_of_their_texture(page: Page, shape: str) -> None:
    page.set({"shape": shape, "tiles": 4})
    data = page.js(
        "const data = window.mbtf.viewer.renderer.shape(arguments[0]);"
        "return Object.fromEntries(Object.entries(data).map(([key, values]) => [key, [...values]]))",
        ASPECT,
    )
    corners = np.array(data["indices"]).reshape(-1, 3)
    p, n, t, uv = (
        np.array(data[key]).reshape(-1, size)[corners]
        for key, size in (("positions", 3), ("normals", 3), ("tangents", 4), ("uvs", 2))
    )
    edges = np.linalg.inv(np.diff(uv, axis=1)) @ np.diff(p, axis=1)
    # Frames at a triangle's center; near the poles of a sphere they differ within a triangle.
    ok = np.abs(n[..., 2]).max(1) < 0.9
    normal, tangent = n.mean(1)[ok], t[..., :3].mean(1)[ok]
    by_u, by_v = edges[ok, 0], edges[ok, 1]
    bitangent = t[ok][:, 0, 3:] * np.cross(normal, tangent)

    def cosine(a: F64, b: F64) -> F64:
        product = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
        return np.asarray(product, np.float64)

    assert cosine(tangent, by_u).min() > 0.95
    assert cosine(bitangent, by_v).min() > 0.85
    # A texture unit is as long as a tile is wide, and as it is high.
    assert np.median(np.linalg.norm(by_v, axis=1)) == pytest.approx(ASPECT, rel=0.1)
    if shape != "sphere":
        assert np.median(np.linalg.norm(by_u, axis=1)) == pytest.approx(1, rel=0.2)

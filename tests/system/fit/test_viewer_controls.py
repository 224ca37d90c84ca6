"""What reaches the screen of the viewer, and what mouse, fingers, panel and links change."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.browser import Page
from support.plugin_materials import write_material

from mbtf_core.color import linear_to_srgb, srgb_to_linear
from mbtf_core.data.lattice import Lattice
from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera
from mbtf_fit.material.transmittance import Transmittance
from mbtf_fit.viewer.extras import picture_content
from mbtf_fit.viewer.page import material_content, write_page

# Values of constant materials; half of the light passes through the last.
VALUES = {"dim": 0.1, "bright": 0.3, "veil": 0.2}
BACKGROUND = np.array([0.11, 0.12, 0.14])
TOP = {"elevation": 90, "azimuth": -90, "tiles_across": 2, "target": [0.5, 0.5, 0]}
ABOVE: dict[str, Any] = {"direction": [0, 0, 1], "color": [1, 1, 1], "intensity": 1}
FLAT = {"camera": TOP, "lights": [ABOVE], "exposure": 0}
STATE = "const { viewer } = window.mbtf, { state, camera, renderer } = viewer;"


@pytest.fixture(scope="module")
def page(driver: Any, tmp_path_factory: pytest.TempPathFactory) -> Page:
    """Constant materials and a picture of four colors; nothing is drawn unless a test asks for it."""
    folder, lattice = tmp_path_factory.mktemp("controls"), Lattice(3, 1.0)
    half = [np.zeros((*lattice.shape(s), 6), np.float32) for s in range(4)]
    for coefficients in half:
        coefficients[..., 0] = 0.5
    for name, value in VALUES.items():
        through = Transmittance(lattice, (0.0,), [half]) if name == "veil" else None
        write_material(folder / name, constant=(value,) * 3, model="neumip-baseline", transmittance=through)
    picture = np.full((60, 60, 3), 0.1, np.float32)
    picture[:30, :, 0] = 0.4
    picture[:, :30, 1] = 0.3
    content = {
        "materials": [material_content(folder / name)[0] for name in VALUES],
        "pictures": [picture_content("path-traced", picture, Camera(50, -90, 2), from_angles(30.0, 0.0))],
    }
    page = Page(driver, write_page(content, "controls"), folder).ready()
    page.js("window.mbtf.viewer.draw = () => false")
    return page


def shown(linear: Any) -> Any:
    """8-bit values of the screen."""
    return 255 * linear_to_srgb(np.asarray(linear, np.float64))


def drag(page: Page, by: tuple[int, int], key: str) -> None:
    """Drag from the center of the canvas by pixels while a key is pressed."""
    from selenium.webdriver.common.action_chains import ActionChains

    actions = ActionChains(page.driver, duration=10).key_down(key)
    actions.move_to_element(page.driver.find_element("id", "canvas"))
    actions.click_and_hold().move_by_offset(*by).release().key_up(key).perform()


def test_the_screen_shows_both_sides_at_an_exposure(page: Page) -> None:
    page.set({**FLAT, "exposure": 1, "against": "material 1", "divide": 0.25})
    found = page.screen([(x, 0.5) for x in (0.1, 0.2, 0.3, 0.9)])
    np.testing.assert_allclose(found[:, 0], shown([0.2, 0.2, 0.6, 0.6]), atol=1.5)
    np.testing.assert_array_equal(found, found[:, :1].repeat(3, 1))


def test_the_background_is_added_to_light(page: Page) -> None:
    """Half of it, in linear values, behind a material that is half transparent; all of it beside a shape."""
    page.set({**FLAT, "material": 2})
    expected = shown(0.2 + 0.5 * srgb_to_linear(BACKGROUND))
    np.testing.assert_allclose(page.screen([(0.5, 0.5)])[0], expected, atol=1.5)
    page.set({**FLAT, "shape": "sphere", "camera": {**TOP, "target": [0, 0, 0]}})
    found = page.screen([(0.5, 0.5), (0.02, 0.02)])
    np.testing.assert_allclose(found, [shown([0.1] * 3), 255 * BACKGROUND], atol=1.5)


def test_the_far_side_of_a_sphere_gets_no_light(page: Page) -> None:
    """Also at its silhouette, where interpolated normals may point away from the viewer."""
    lit = 0
    for azimuth in (-60.0, -61.3):
        for elevation in (0, 20):
            view = {"elevation": elevation, "azimuth": azimuth, "target": [0, 0, 0], "tiles_across": 1.5}
            from_right = {**ABOVE, "direction": from_angles(0.0, azimuth + 90).tolist()}
            page.set({"camera": view, "lights": [from_right], "shape": "sphere"})
            found = page.picture(300, 400)
            left, right = found[:, :190], found[:, 210:]
            assert (left[..., 3] > 0).mean() > 0.3
            assert (right[..., :3].max(2) > 0)[right[..., 3] > 0].mean() > 0.99
            lit += int((left[..., :3].max(2) > 0).sum())
    # Of 95,000 pixels.
    assert lit < 5


def test_a_texel_moves_with_the_pointer(page: Page) -> None:
    box = page.js("return document.getElementById('canvas').getBoundingClientRect().toJSON()")

    def texel(x: float, y: float) -> list[float]:
        """At pixels from the center of the canvas."""
        found = page.pick(0.5 + x / box["width"], 0.5 + y / box["height"])
        assert found is not None
        return list(found["u"])

    page.set({**FLAT, "camera": {**TOP, "target": [0.3, 0.6, 0]}})
    before = texel(0, 0)
    drag(page, (40, -30), "\ue009")
    assert texel(40, -30) == pytest.approx(before, abs=0.02)


def test_a_reference_picture_fixes_the_view(page: Page) -> None:
    """The picture is M, which unit irradiance lights; its rows begin at the top."""
    page.set({**FLAT, "lights": [ABOVE, ABOVE], "environment": {"name": "sky"}, "shape": "sphere"})
    page.choose("against", "picture 0")
    page.choose("intensity", 1)
    found = page.js(STATE + "return [renderer.lit, state.shape, camera.tiles_across, camera.azimuth]")
    assert found == [False, "plane", 2, -90]
    page.js(STATE + "state.divide = 0.02")
    found = page.screen([(0.01, 0.5), (0.25, 0.25), (0.75, 0.75)])
    np.testing.assert_allclose(found, shown([[0.1] * 3, [0.4, 0.3, 0.1], [0.1] * 3]), atol=1.5)
    page.choose("against", "none")

"""The viewer in a headless browser: values, pictures, controls, and what it says where it cannot draw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.browser import Page
from support.material_cases import CASES, make
from support.plugin_materials import write_material

from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera
from mbtf_fit.viewer.page import as_read, encode, material_content, pack_textures, write_page


def test_values_are_those_of_the_material(driver: Any, tmp_path: Path) -> None:
    """Against PyTorch on the same textures; the page itself compares with the exact material."""
    materials = {case: make(case, tmp_path / str(k)) for k, case in enumerate(CASES)}
    contents = [material_content(tmp_path / str(k), case)[0] for k, case in enumerate(CASES)]
    page = Page(driver, write_page({"materials": contents}, "cases"), tmp_path).ready()
    tests = page.js("return window.mbtf.tests")
    for test, (case, material) in zip(tests, materials.items(), strict=True):
        expected = as_read(material, pack_textures(material)).conformance["rgb"]
        found = np.array(test["values"]).reshape(-1, 4)[:, :3]
        deviation = np.abs(found - expected) / np.maximum(1.0, expected)
        assert (expected.std() > 0.005) == (case != "black"), case
        # Features have half precision, whose errors short axes enlarge; a traced ray may miss an edge.
        limit = 1e-2 if case == "frames without axes" else 3e-3
        assert (deviation.max(1) > limit).sum() <= 2, (case, deviation.max())
        exact = np.abs(found - material.conformance["rgb"]) / np.maximum(1.0, material.conformance["rgb"])
        assert test["largest"] == pytest.approx(exact.max(), rel=1e-3, abs=1e-6)
        assert test["beyond"] == (exact.max(1) > 1e-2).sum()
    # The texels of random materials are noise, which is the hardest to round.
    assert sum(test["beyond"] for test in tests) < 40
    # On devices with other rounding.
    page.js("Object.assign(window.mbtf.tests[0], { beyond: 1, count: 256, largest: 0.02345 })")
    page.js("window.mbtf.viewer.draw = () => true")
    status = "return document.getElementById('status').textContent"
    page.until(lambda: page.js(status).endswith(", 1 of 256 test queries deviate, by up to 2.3%"))
    assert page.faults() == []


def test_holes_show_the_background(driver: Any, tmp_path: Path) -> None:
    material = make("holes", tmp_path / "material")
    content = material_content(tmp_path / "material")[0]
    view = {"elevation": 60, "azimuth": -90, "tiles_across": 2, "target": [0.5, 0.5, 0]}
    page = Page(driver, write_page({"materials": [content]}, "holes"), tmp_path, {"camera": view}).ready()
    found = page.picture(16, 24)[..., 3]
    q = Camera(60, -90, 2, rows=16, columns=24).queries(from_angles(45.0, 45.0), 0.5)
    read = as_read(material, pack_textures(material)).transmittance
    assert read is not None
    flat = (a.reshape(-1, *a.shape[2:]) for a in (q.u, q.sigma, q.omega_o))
    expected = 1.0 - read.evaluate(*flat).reshape(16, 24)
    assert expected.std() > 0.05
    np.testing.assert_allclose(found, expected, atol=0.03)


def test_a_link_restores_the_view(driver: Any, tmp_path: Path) -> None:
    make("relief", tmp_path / "one")
    make("calibrated", tmp_path / "two")
    contents = [material_content(tmp_path / n)[0] for n in ("one", "two")]
    page = Page(driver, write_page({"materials": contents}, "two materials"), tmp_path).ready()
    page.choose("against", "material 1")
    assert [e.is_displayed() for e in driver.find_elements("css selector", ".side")] == [True, True]
    view = (
        "const { camera, state } = window.mbtf.viewer; return [camera.azimuth, state.divide, state.against]"
    )
    page.js("const { camera, state } = window.mbtf.viewer; camera.azimuth = -120; state.divide = 0.3")
    page.js("document.getElementById('link').click()")
    link = page.js("return location.href")
    driver.get("about:blank")
    driver.get(link)
    page.ready()
    assert page.js(view) == [-120, 0.3, "material 1"]
    assert page.faults() == []


def test_surroundings_light_a_plane(driver: Any, tmp_path: Path) -> None:
    """By irradiance 1, whatever the picture's brightness; all shapes draw something that is finite."""
    white = write_material(tmp_path / "white", constant=(0.2, 0.2, 0.2), model="neumip-baseline")
    assert white.conformance["rgb"].min() > 0.19
    gray = np.full((4, 8, 3), 0.5, np.float32)
    content = {
        "materials": [material_content(tmp_path / "white")[0]],
        "environment": {"name": "gray", "shape": [4, 8], "data": encode(gray)},
    }
    # Without a view that is given, the light swings at first.
    page = Page(driver, write_page(content, "shapes"), tmp_path, {}).ready()
    for shape in ("sphere", "cloth", "plane"):
        page.choose("shape", shape)
        found = page.picture(20, 30)
        assert np.isfinite(found).all()
        assert found[found[..., 3] == 1][:, :3].max() > 0.1, shape
    page.choose("environment", "gray")
    page.js("window.mbtf.viewer.state.lights.length = 0")
    assert page.picture(64, 96)[..., :3].mean() == pytest.approx(0.2, rel=0.03)
    assert page.faults() == []

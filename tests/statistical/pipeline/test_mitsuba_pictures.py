"""Unmodified Mitsuba renders the same image, and differences are detected."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.unmodified_mitsuba import agree, differences, lambertian, render_both

from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_gen.tile.loading import load_material

CAMERA, LIGHT = Camera(82, -60, 0.6, rows=40, columns=40), from_angles(45, 35)


@pytest.fixture(scope="module")
def glossy(tmp_path_factory: pytest.TempPathFactory) -> HeightFieldTile:
    """A 2:1 height field with a colored, glossy surface and no symmetry."""
    folder = tmp_path_factory.mktemp("material")
    random = np.random.default_rng(5)
    np.save(folder / "height.npy", np.kron(random.random((8, 16)), np.ones((2, 2))))
    colors = np.kron(random.integers(40, 255, (8, 16, 3)), np.ones((2, 2, 1))).astype(np.uint8)
    Image.fromarray(colors).save(folder / "base_color.png")
    (folder / "material.yaml").write_text(
        "height: {file: height.npy, scale: 0.06}\nbase_color: base_color.png\nroughness: 0.4\n"
    )
    return load_material(folder / "material.yaml")


def config(material: Path | str) -> GeneratorConfig:
    return GeneratorConfig.model_validate({"material": str(material), "geometry": {"mesh": 32}})


def test_mitsuba_agrees_with_and_without_gloss(glossy: HeightFieldTile) -> None:
    bare = render_both(config("unused"), lambertian(glossy), CAMERA, LIGHT)
    full = render_both(config("unused"), glossy, CAMERA, LIGHT)
    for pair in (bare, full):
        found = differences(*pair)
        assert agree(*found), found
        # Wide error bars could hide a difference.
        assert max(estimate.error for estimate in found) < 0.01
    # Without gloss the image differs clearly.
    assert not agree(*differences(bare[0], full[0]))


def test_a_shifted_image_differs(glossy: HeightFieldTile) -> None:
    """The camera of Mitsuba is shifted by a texel, which preserves the mean."""
    moved = dataclasses.replace(CAMERA, target=(0.5 + 1 / 16, 0.5))
    found = differences(*render_both(config("unused"), lambertian(glossy), CAMERA, LIGHT, moved))
    assert not agree(*found)
    assert found[1].value > 10 * found[1].error


def test_cloth_of_two_colors_and_roughnesses_agrees(tmp_path: Path) -> None:
    (tmp_path / "cloth.yaml").write_text(
        "weave: plain\nyarn: {type: rayon1, fibers: 5, radius: 8, flyaways: 0}\n"
        "yarns: {red: {color: [0.9, 0.3, 0.1], roughness: 0.7}, blue: {color: [0.1, 0.3, 0.9], ior: 1.4}}\n"
        "warp: red\nweft: blue\n"
    )
    cloth = tmp_path / "cloth.yaml"
    described = GeneratorConfig.model_validate({"material": str(cloth)})
    found = differences(*render_both(described, load_material(cloth), CAMERA, LIGHT))
    assert agree(*found), found
    assert found[0].error < 0.05

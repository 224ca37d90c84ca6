"""Unmodified Mitsuba renders the same image, and differences are detected."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support import unmodified_mitsuba
from support.unmodified_mitsuba import agreement, compare_with_mitsuba

from mbtf_core.pictures import Camera
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_gen.tile.loading import load_material
from mbtf_pipeline.recipe import CompareSection

SCENE = {"views": [{"elevation": 82, "azimuth": -60}], "lights": [{"elevation": 45, "azimuth": 35}]}
SECTION = CompareSection.model_validate({**SCENE, "tiles_across": [0.6], "size": 40, "spp": 32})


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
    found = compare_with_mitsuba(SECTION, config("unused"), glossy)
    assert list(found) == ["base color", "full"]
    for f in found.values():
        assert f.verdict == "agree", (f.mean, f.square)
        # Wide error bars could hide a difference.
        assert f.mean.error < 0.01
        assert f.square.error < 0.01
    # Without gloss the image differs clearly.
    bare, full = (f.mbtf for f in found.values())
    assert agreement((bare, bare), (full, full)).verdict == "differ"


def test_a_shifted_image_differs(glossy: HeightFieldTile, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera of Mitsuba is shifted by a texel, which preserves the mean."""
    real = unmodified_mitsuba.render_with_mitsuba

    def moved(job: Job, camera: Camera, *others: Any) -> object:
        return real(job, dataclasses.replace(camera, target=(0.5 + 1 / 16, 0.5)), *others)

    monkeypatch.setattr(unmodified_mitsuba, "render_with_mitsuba", moved)
    found = compare_with_mitsuba(SECTION, config("unused"), glossy)["base color"]
    assert found.verdict == "differ"
    assert found.square.value > 10 * found.square.error


def test_cloth_of_two_colors_and_roughnesses_agrees(tmp_path: Path) -> None:
    (tmp_path / "cloth.yaml").write_text(
        "weave: plain\nyarn: {type: rayon1, fibers: 5, radius: 8, flyaways: 0}\n"
        "yarns: {red: {color: [0.9, 0.3, 0.1], roughness: 0.7}, blue: {color: [0.1, 0.3, 0.9], ior: 1.4}}\n"
        "warp: red\nweft: blue\n"
    )
    described = GeneratorConfig.model_validate({"material": str(tmp_path / "cloth.yaml")})
    (found,) = compare_with_mitsuba(SECTION, described, load_material(tmp_path / "cloth.yaml")).values()
    assert found.verdict == "agree", (found.mean, found.square)
    assert found.mean.error < 0.05


def test_noise_of_both_sides_cancels() -> None:
    random = np.random.default_rng(3)
    truth = 0.5 + random.random((64, 64, 3))
    a, b, c, d = (truth + 0.3 * random.standard_normal(truth.shape) for _ in range(4))
    same = agreement((a, b), (c, d))
    assert abs(same.square.value) < 4 * same.square.error
    assert same.verdict == "agree"
    wrong = truth + 0.2 * np.sign(random.standard_normal(truth.shape))
    other = agreement((a, b), (wrong, wrong))
    assert other.square.value == pytest.approx(0.04, abs=4 * other.square.error)
    assert other.verdict == "differ"


@pytest.mark.parametrize("size", [1, 31, 32, 48])
def test_small_images_are_inconclusive(size: int) -> None:
    random = np.random.default_rng(7)
    truth = 0.5 + random.random((size, size, 3))
    a, b, c, d = (truth + 0.02 * random.standard_normal(truth.shape) for _ in range(4))
    same, other = agreement((a, b), (c, d)), agreement((a, b), (1.5 * c, 1.5 * d))
    assert other.mean.value == pytest.approx(-0.4, abs=0.05)
    expected = ("agree", "differ") if size >= 32 else ("inconclusive",) * 2
    assert (same.verdict, other.verdict) == expected

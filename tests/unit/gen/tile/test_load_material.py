"""Materials from bare files, folders and YAML: what is found, assumed, refused, documented, and kept."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from support import image_files
from support.image_files import rng
from support.paths import ROOT

from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import InputError
from mbtf_gen.tile.loading import latest_material, load_material


def png(path: Path, codes: NDArray[Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(codes).save(path)
    return path


def codes(rows: int, columns: int, *channels: int) -> NDArray[np.uint8]:
    return rng().integers(0, 256, (rows, columns, *channels)).astype(np.uint8)


def npy(path: Path, numbers: NDArray[Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, numbers)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A complete set of maps at three resolutions, 2:1."""
    out = tmp_path / "rock"
    npy(out / "rock_height.npy", rng().random((8, 16)))
    png(out / "Rock_BaseColor.png", codes(16, 32, 3))
    png(out / "rock-rough.png", codes(4, 8))
    png(out / "rock.metallic.png", codes(8, 16))
    png(out / "rockNormalGL.png", np.full((8, 16, 3), (128, 128, 255), np.uint8))
    png(out / "rock_opacity.png", codes(8, 16))
    png(out / "rock_ao.png", codes(8, 16))
    (out / "LICENSE.txt").write_text("CC0")
    return out


class TestBareFile:
    def test_float_heights_are_tile_widths(self, tmp_path: Path) -> None:
        heights = rng().random((6, 9))
        material = load_material(npy(tmp_path / "h.npy", heights))
        assert np.array_equal(material.height, heights)
        assert (material.height_scale, material.facts["height"].bits) == (1.0, None)
        assert material.aspect == pytest.approx(6 / 9)
        assert material.is_lambert
        assert np.array_equal(material.maps["base_color"], np.full(3, 0.5))
        assert material.warnings == ()

    def test_a_large_displacement_at_the_default_scale_warns(self, tmp_path: Path) -> None:
        material = load_material(npy(tmp_path / "h.npy", np.array([[0.0, 0.6]])))
        assert "the displacement range is 0.6" in material.warnings_in_use()[0]
        assert material.at(1.0).warnings_in_use() == ()
        assert load_material(npy(tmp_path / "h.npy", np.array([[0.0, 0.5]]))).warnings_in_use() == ()


def test_default_mesh_follows_the_map_up_to_a_limit(tmp_path: Path) -> None:
    assert load_material(npy(tmp_path / "a.npy", rng().random((30, 20)))).grid.z.shape == (30, 20)
    wide = load_material(npy(tmp_path / "b.npy", rng().random((100, 1000))))
    assert wide.grid.z.shape == (51, 512)
    assert wide.grid.aspect == 0.1


class TestFolder:
    def test_single_pixels_are_constants_of_any_aspect(self, folder: Path) -> None:
        png(folder / "rock-rough.png", np.full((1, 1), 51, np.uint8))
        png(folder / "Rock_BaseColor.png", np.full((1, 1, 3), 255, np.uint8))
        material = load_material(folder)
        assert material.maps["roughness"] == pytest.approx(0.2)
        assert material.maps["base_color"] == pytest.approx(np.ones(3))

    def test_rounded_sizes_are_no_other_aspect(self, tmp_path: Path) -> None:
        npy(tmp_path / "height.npy", np.zeros((683, 1024)))
        png(tmp_path / "rough.png", codes(1365, 2048))
        assert np.shape(load_material(tmp_path).maps["roughness"]) == (1365, 2048)
        png(tmp_path / "rough.png", codes(1362, 2048))
        with pytest.raises(InputError, match="one aspect"):
            load_material(tmp_path)


class TestYaml:
    def write(self, folder: Path, text: str) -> Path:
        path = folder / "material.yaml"
        path.write_text(text)
        return path

    def test_files_are_relative_to_the_yaml(
        self, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        text = "height: {file: rock_height.npy, scale: 0.2}\nroughness: rock-rough.png\nmetallic: 1\n"
        text += "base_color: {value: [0.5, 0.25, 1.0], colorspace: srgb}\nspecular: {value: 0.25}\n"
        path = self.write(folder, text)
        for source in (path, folder, path.relative_to(tmp_path)):
            material = load_material(source)
            assert material.height_scale == 0.2
            assert material.maps["base_color"] == pytest.approx(srgb_to_linear([0.5, 0.25, 1.0]))
            assert np.shape(material.maps["roughness"]) == (4, 8)
            assert (material.maps["metallic"], material.maps["specular"]) == (1.0, 0.25)

    def test_bsdf_is_passed_on(self, folder: Path) -> None:
        bsdf = "{type: roughconductor, alpha: 0.2, nested: {flag: true, filename: rock_ao.png}}"
        material = load_material(self.write(folder, f"height: rock_height.npy\nbsdf: {bsdf}\n"))
        nested = {"flag": True, "filename": str(folder / "rock_ao.png")}
        assert material.bsdf == {"type": "roughconductor", "alpha": 0.2, "nested": nested}
        assert type(material.bsdf["alpha"]) is float
        assert "bsdf.0" in material.digests


class TestDigests:
    def test_settings_of_the_yaml_count_and_its_layout_does_not(self, folder: Path) -> None:
        path = folder / "material.yaml"

        def digests(text: str) -> dict[str, str]:
            path.write_text(text)
            return load_material(path).digests

        base = digests("height: rock_height.npy\nroughness: 0.5\n")
        same = "# remark\nroughness: {value: 0.5}\nheight: {file: rock_height.npy, scale: 1}\n"
        assert digests(same) == base
        for text in (
            "height: rock_height.npy\nroughness: 0.6\n",
            "height: rock_height.npy\nmetallic: 0.5\n",
            "height: {file: rock_height.npy, scale: 0.5}\nroughness: 0.5\n",
            "height: rock_height.npy\nbsdf: {type: diffuse}\n",
        ):
            assert digests(text)["settings"] != base["settings"]

    def test_a_bare_file_and_the_same_in_yaml_agree(self, folder: Path) -> None:
        path = folder / "material.yaml"
        path.write_text("height: rock_height.npy\n")
        assert load_material(path).digests == load_material(folder / "rock_height.npy").digests


@pytest.fixture
def changing(tmp_path: Path) -> Path:
    png(tmp_path / "height.png", np.arange(64, dtype=np.uint8).reshape(8, 8))
    png(tmp_path / "roughness.png", np.full((8, 8), 90, np.uint8))
    return tmp_path


def test_an_unchanged_material_is_not_decoded_again(changing: Path) -> None:
    first = latest_material(changing)
    assert latest_material(changing) is first
    # A job states the method that it found.
    assert latest_material(changing, "none") is first
    assert latest_material(changing, "mirror") is not first


def test_a_changed_folder_is_loaded_again(changing: Path) -> None:
    first = latest_material(changing)
    # As many bytes, and the same times, as before.
    path = changing / "roughness.png"
    stat = path.stat()
    png(path, np.full((8, 8), 200, np.uint8))
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    second = latest_material(changing)
    before, after = (np.asarray(m.maps["roughness"], np.float64).mean() for m in (first, second))
    assert after > before
    png(changing / "metallic.png", np.full((8, 8), 255, np.uint8))
    assert np.mean(latest_material(changing).maps["metallic"]) == 1.0 != np.mean(second.maps["metallic"])
    (changing / "material.yaml").write_text("height: {file: height.png, scale: 0.3}\n", encoding="utf-8")
    assert latest_material(changing).height_scale == 0.3
    (changing / "height.png").unlink()
    with pytest.raises(InputError):
        latest_material(changing)


DOCUMENT = (ROOT / "docs/reference/material-yaml.md").read_text()


def test_the_example_is_valid(tmp_path: Path) -> None:
    """The document's material file, with maps of those names beside it."""
    text = DOCUMENT.split("```yaml\n", 1)[1].split("```", 1)[0]
    (tmp_path / "material.yaml").write_text(text)
    for name in ("diff", "arm", "nor"):
        image_files.png(tmp_path / f"cliff_{name}.png", rng().integers(100, 200, (8, 8, 3)), 2, 8)
    layers = {n: rng().random((8, 8)).astype(np.float32) for n in ("R", "G", "B", "displacement.Y")}
    image_files.exr(tmp_path / "cliff.exr", layers)
    material = load_material(tmp_path)
    assert np.array_equal(material.height, layers["displacement.Y"])
    assert material.height_scale == 0.12

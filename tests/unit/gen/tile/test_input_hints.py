"""Lines about inputs that are read otherwise than their makers may have meant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from support.fit_data import constant, write_data

from mbtf_core.errors import InputError
from mbtf_gen.tile.loading import load_material

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


def test_texture_coordinates_without_an_image(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(f"{SQUARE}f 1/1 2/2 3/3 4/4\n")
    assert any("names no image" in text for text in load_material(tmp_path / "a.obj").warnings)
    (tmp_path / "a.yaml").write_text("mesh: a.obj\nbase_color: 0.3\n")
    assert not any("names no image" in text for text in load_material(tmp_path / "a.yaml").warnings)
    (tmp_path / "b.obj").write_text(f"{SQUARE}f 1 2 3 4\n")
    assert not any("names no image" in text for text in load_material(tmp_path / "b.obj").warnings)


def test_a_color_that_darkens_its_image(tmp_path: Path) -> None:
    Image.new("RGB", (2, 2), (255, 255, 255)).save(tmp_path / "a.png")
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\nusemtl m\n{SQUARE}f 1/1 2/2 3/3 4/4\n")
    for factor, warned in (("0.8 0.8 0.8", True), ("1 1 1", False)):
        (tmp_path / "a.mtl").write_text(f"newmtl m\nKd {factor}\nmap_Kd a.png\n")
        warnings = load_material(tmp_path / "a.obj").warnings
        assert any(f"Kd {factor} darkens map_Kd" in text for text in warnings) == warned


def test_a_folder_of_a_mesh_names_it(tmp_path: Path) -> None:
    (tmp_path / "scene.obj").write_text(f"{SQUARE}f 1 2 3 4\n")
    with pytest.raises(InputError) as caught:
        load_material(tmp_path)
    assert "scene.obj" in caught.value.hint


def test_a_data_set_is_no_material(tmp_path: Path) -> None:
    folder = write_data(tmp_path / "shards", constant(0.5), train=10, test=10)
    with pytest.raises(InputError, match=f"it is a data set; fit it with: mbtf-fit {folder}"):
        load_material(folder)
    (tmp_path / "geometry.exr").write_bytes((folder / "geometry.exr").read_bytes())
    with pytest.raises(InputError, match="its name must contain one of"):
        load_material(tmp_path)


@pytest.mark.parametrize(("name", "warned"), [("x_albedo_acescg.exr", True), ("x_albedo.exr", False)])
def test_a_color_space_that_only_the_name_says(name: str, warned: bool, tmp_path: Path) -> None:
    Image.fromarray(np.arange(16, dtype=np.uint16).reshape(4, 4) * 4000).save(tmp_path / "x_height.png")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = np.full((4, 4, 3), 0.4, np.float32)
    OpenEXR.File(header, {"RGB": OpenEXR.Channel(pixels)}).write(str(tmp_path / name))
    assert any("acescg" in text for text in load_material(tmp_path).warnings) == warned

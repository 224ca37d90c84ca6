"""Which files of a folder are maps: what all names share, packed maps, and what is left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mbtf_core.errors import InputError
from mbtf_gen.tile.loading import load_material
from mbtf_gen.tile.maps.discovery import find_maps, role_of


def fill(folder: Path, *names: str) -> Path:
    """A folder of empty files: names alone decide."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).touch()
    return folder


def found(folder: Path, *names: str) -> dict[str, str]:
    return {role: path.name for role, path in find_maps(fill(folder, *names)).maps.items()}


class TestSharedWords:
    def test_a_preview_named_like_the_asset_is_no_map(self, tmp_path: Path) -> None:
        plain = ["PaintedMetal004_1K_Color.png", "PaintedMetal004_1K_Displacement.png"]
        expected = {"base_color": plain[0], "height": plain[1]}
        names = [*plain, "PaintedMetal004.png"]
        assert found(tmp_path / "a", *names) == expected
        assert find_maps(tmp_path / "a").unused == {"PaintedMetal004.png": "its name matches no map"}
        metal = "PaintedMetal004_1K_Metalness.png"
        assert found(tmp_path / "b", *names, metal) == {**expected, "metallic": metal}

    def test_letters_behind_a_telling_asset(self, tmp_path: Path) -> None:
        names = [f"T_MetalPlate_{letter}.png" for letter in "DHN"]
        with pytest.raises(InputError, match="no height map among") as caught:
            find_maps(fill(tmp_path, *names))
        assert f"(their names match no map: {', '.join(names)})" in caught.value.hint
        assert "name it in a material.yaml" in caught.value.hint

    @pytest.mark.parametrize(
        "expected",
        [
            {"height": "rock_height.png"},
            {"height": "rock_height.png", "opacity": "rock_height_mask.png"},
            {"height": "metal_disp.png", "roughness": "metal_rough.png", "metallic": "metal_metal.png"},
        ],
    )
    def test_words_decide_roles(self, expected: dict[str, str], tmp_path: Path) -> None:
        assert found(tmp_path, *expected.values()) == expected


class TestPacked:
    @pytest.mark.parametrize("name", ["chair_metallicRoughness", "a-metallic-roughness", "RoughnessMetallic"])
    def test_two_words_are_one_map(self, name: str) -> None:
        assert role_of(f"{name}.png") is None
        assert role_of(f"{name}_normal.png") == "normal"

    @pytest.mark.parametrize(
        ("name", "roughness", "metallic"),
        [("x_orm", "G", "B"), ("x_ARM", "G", "B"), ("x_rma", "R", "G"), ("x_metallicRoughness", "G", "B")],
    )
    def test_a_packed_map_warns_where_maps_are_missing(
        self, name: str, roughness: str, metallic: str, tmp_path: Path
    ) -> None:
        maps = find_maps(fill(tmp_path, "x_height.png", f"{name}.png"))
        (warning,) = maps.warnings
        assert "so that the surface is Lambert" in warning
        assert f"roughness: {{file: {name}.png, channel: {roughness}}}" in warning
        assert f"metallic: {{file: {name}.png, channel: {metallic}}}" in warning
        (warning,) = find_maps(fill(tmp_path, "x_rough.png")).warnings
        assert "and its map is missing" in warning
        assert "roughness:" not in warning
        assert find_maps(fill(tmp_path, "x_metal.png")).warnings == []
        assert f"{name}.png" in find_maps(tmp_path).unused

    def test_gloss(self, tmp_path: Path) -> None:
        (warning,) = find_maps(fill(tmp_path, "height.png", "gloss.png")).warnings
        assert "roughness: {file: gloss.png, invert: true}" in warning
        assert find_maps(fill(tmp_path, "rough.png")).warnings == []

    def test_the_material_warns(self, tmp_path: Path) -> None:
        for name in ("height", "orm"):
            np.save(tmp_path / f"{name}.npy", 0.1 * np.random.default_rng(0).random((4, 4)))
        material = load_material(tmp_path)
        assert any("orm.npy: is not used" in w for w in material.at(0.1).warnings_in_use())
        assert list(material.unused) == ["orm.npy"]


class TestOtherPlaces:
    def test_an_archive_is_to_be_unpacked(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="contains no image") as caught:
            find_maps(fill(tmp_path, "Rock.zip", "LICENSE.txt"))
        assert caught.value.hint == "unpack Rock.zip and give its folder"
        with pytest.raises(InputError, match=r"'\.zip' is not a height map") as caught:
            load_material(tmp_path / "Rock.zip")
        assert caught.value.hint == "unpack Rock.zip and give its folder"

    @pytest.mark.parametrize("beside", [(), ("preview.png", "Rock.zip")])
    def test_maps_one_folder_below(self, tmp_path: Path, beside: tuple[str, ...]) -> None:
        fill(tmp_path, *beside)
        fill(tmp_path / "licences", "readme.png")
        fill(tmp_path / "textures", "rock_height.png")
        with pytest.raises(InputError) as caught:
            find_maps(tmp_path)
        assert caught.value.hint == f"did you mean '{tmp_path / 'textures'}'?"

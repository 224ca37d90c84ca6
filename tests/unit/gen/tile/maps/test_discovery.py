"""Which files of a folder are maps: what all names share, packed maps, and what is left out."""

from __future__ import annotations

from pathlib import Path

import pytest

from mbtf_core.errors import InputError
from mbtf_gen.tile.maps.discovery import find_maps


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

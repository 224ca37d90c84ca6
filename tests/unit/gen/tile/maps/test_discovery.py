"""Which files of a folder are maps: what all names share, sites, packed maps, and what is left out."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from mbtf_core.config.yaml_file import read_yaml
from mbtf_core.errors import InputError
from mbtf_gen.tile.maps.discovery import find_maps


def fill(folder: Path, *names: str) -> Path:
    """A folder of empty files: names alone decide."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).touch()
    return folder


def test_a_preview_named_like_the_asset_is_no_map(tmp_path: Path) -> None:
    names = ("PaintedMetal004_1K_Color.png", "PaintedMetal004_1K_Displacement.png", "PaintedMetal004.png")
    assert {path.name for path in find_maps(fill(tmp_path, *names)).maps.values()} == {*names[:2]}


# Folders as sites name them: the common start of all names, then their rests. Those that are maps
# have the entry of a material file, in words: role=file[channel], with a "1-" where the map is inverted.
SITES = {
    "ambientCG": "Metal032_1K-JPG_ base_color=Color.jpg height=Displacement.jpg NormalDX.jpg "
    "normal=NormalGL.jpg roughness=Roughness.jpg metallic=Metalness.jpg AmbientOcclusion.jpg",
    "Poly Haven": "brick_001_ base_color=diff_4k.jpg height=disp_4k.png normal=nor_gl_4k.exr "
    "nor_dx_4k.exr roughness=rough_4k.exr metallic=arm_4k.jpg[B] ao_4k.jpg",
    "Poly Haven, colors": "fabric_07_ col_2_1k.png base_color=col_1_1k.png height=disp_1k.png",
    "Poliigon": "Grass002_ AO_1K.jpg base_color=COL_VAR1_1K.jpg COL_VAR2_1K.jpg height=DISP16_3K.tif "
    "DISP_1K.jpg roughness=1-GLOSS_1K.jpg normal=NRM16_1K.tif NRM_1K.jpg",
    "Poliigon, two workflows": "Metal_ base_color=COL_2K_METALNESS.png COL_2K_SPECULAR.png "
    "DISP_2K_METALNESS.png height=DISP16_2K_METALNESS.png GLOSS_2K_SPECULAR.png "
    "roughness=ROUGHNESS_2K_METALNESS.png metallic=METALNESS_2K_METALNESS.png normal=NRM_2K_METALNESS.png "
    "NRM_2K_SPECULAR.png REFL_2K_SPECULAR.png",
    "Megascans": "uigjaeoic_2K_ base_color=Albedo.jpg AO.jpg Bump.jpg Cavity.jpg height=Displacement.exr "
    "Gloss.jpg normal=Normal.jpg NormalBump.jpg roughness=Roughness.jpg opacity=Opacity.jpg Diffuse.jpg",
    "FreePBR": "rocky-shoreline1- base_color=albedo.png ao.png height=height.png normal=normal-ogl.png "
    "normal-dx.png roughness=roughness.png metallic=metallic.png",
    "Painter": "Mat_ base_color=Base_Color.png height=Height.png Mixed_AO.png Normal_DirectX.png "
    "normal=Normal_OpenGL.png roughness=OcclusionRoughnessMetallic.png[G] "
    "metallic=OcclusionRoughnessMetallic.png[B]",
    "Unity, URP": "Mat_ base_color=AlbedoTransparency.png opacity=AlbedoTransparency.png[A] "
    "height=Height.png roughness=1-MetallicSmoothness.png[A] metallic=MetallicSmoothness.png[R] "
    "normal=Normal.png",
    "Unity, HDRP": "Rock_ base_color=BaseMap.tga roughness=1-MaskMap.tga[A] metallic=MaskMap.tga[R] "
    "normal=Normal.tga BentNormalMap.tga height=Height.png",
    "all lower case": "mat_ normal=normalmap.png height=heightmap.png base_color=colormap.png "
    "roughness=roughnessmap.png ambientocclusion.png",
}


def in_words(role: str, entry: str | dict[str, Any], start: str) -> str:
    options = {"file": entry} if isinstance(entry, str) else entry
    channel = f"[{options['channel']}]" if "channel" in options else ""
    return f"{role}={'1-' if options.get('invert') else ''}{options['file'].removeprefix(start)}{channel}"


class TestSites:
    @pytest.mark.parametrize("site", SITES)
    def test_what_is_certain_is_used(self, site: str, tmp_path: Path) -> None:
        start, *words = SITES[site].split()
        files = {start + re.sub(r".*=(1-)?|\[.\]", "", word) for word in words}
        maps = find_maps(fill(tmp_path, *sorted(files)))
        entries = {in_words(role, entry, start) for role, entry in maps.entries.items()}
        assert entries == {word for word in words if "=" in word}
        # Nothing that a surface shows is left out, but for normals of another kind.
        assert all("normal map" in warning for warning in maps.warnings)

    def test_all_that_is_ambiguous_is_refused_at_once(self, tmp_path: Path) -> None:
        names = ["r_disp.exr", "r_disp.png", "r_diff_1k.png", "r_diff_2k.png", "r_orm.png", "r_nor.png"]
        with pytest.raises(InputError, match="two maps or more of") as caught:
            find_maps(fill(tmp_path, *names))
        assert all(name in caught.value.what for name in names[:4])
        # The hint is a material file.
        (tmp_path / "material.yaml").write_text(caught.value.hint.partition("material.yaml: ")[2])
        assert read_yaml(tmp_path / "material.yaml") == {
            "height": "r_disp.exr",
            "base_color": "r_diff_1k.png",
            "roughness": {"file": "r_orm.png", "channel": "G"},
            "metallic": {"file": "r_orm.png", "channel": "B"},
            "normal": "r_nor.png",
        }

    @pytest.mark.parametrize(
        ("names", "expected"),
        [
            ("col_1 col_2 disp_1 disp_2", "col_1 disp_1"),
            ("col col_VAR2 disp", "col disp"),
            ("col_1 col_2 disp_3", None),
        ],
    )
    def test_variants_go_together(self, names: str, expected: str | None, tmp_path: Path) -> None:
        fill(tmp_path, *(f"x_{name}.png" for name in names.split()))
        if expected is None:
            with pytest.raises(InputError, match="two maps or more of base_color"):
                find_maps(tmp_path)
        else:
            files = {path.name for path in find_maps(tmp_path).maps.values()}
            assert files == {f"x_{name}.png" for name in expected.split()}

    @pytest.mark.parametrize(
        "names",
        ["a_disp16.png b_disp.png", "x_col.1001.png x_col.1002.png x_disp.png", "a_bump.png b_disp.png"],
    )
    def test_other_assets_are_no_variants(self, names: str, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="two maps or more of"):
            find_maps(fill(tmp_path, *names.split()))


class TestPacked:
    @pytest.mark.parametrize(
        ("name", "roughness", "metallic"),
        [
            ("x_ARM", "G", "B"),
            ("x_rma", "R", "G"),
            ("x_MRAO", "G", "R"),
            ("x_RoughnessMetallicAO", "R", "G"),
        ],
    )
    def test_its_name_says_what_its_channels_are(
        self, name: str, roughness: str, metallic: str, tmp_path: Path
    ) -> None:
        file = f"{name}.png"
        maps = find_maps(fill(tmp_path, "x_height.png", file))
        assert maps.entries["roughness"] == {"file": file, "channel": roughness}
        assert maps.entries["metallic"] == {"file": file, "channel": metallic}
        assert maps.warnings == []

    def test_an_order_that_is_not_certain_is_not_used(self, tmp_path: Path) -> None:
        maps = find_maps(fill(tmp_path, "x_height.png", "x_RoughnessMetallic.png"))
        assert maps.maps.keys() == {"height"}
        assert "channel" in maps.warnings[0]

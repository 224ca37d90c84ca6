"""Which files of a folder are maps: what all names share, sites, packed maps, and what is left out."""

from __future__ import annotations

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


def found(folder: Path, *names: str) -> dict[str, str]:
    return {role: path.name for role, path in find_maps(fill(folder, *names)).maps.items()}


class TestSharedWords:
    def test_a_preview_named_like_the_asset_is_no_map(self, tmp_path: Path) -> None:
        plain = ["PaintedMetal004_1K_Color.png", "PaintedMetal004_1K_Displacement.png"]
        expected = {"base_color": plain[0], "height": plain[1]}
        assert found(tmp_path, *plain, "PaintedMetal004.png") == expected


# Folders as sites and programs name them → entries of a material file, in words: role=file[channel], with a
# "1-" where the map is inverted. A star stands for the common start.
SITES = {
    "ambientCG": (
        "Metal032_1K-JPG_",
        "*Color.jpg *Displacement.jpg *NormalDX.jpg *NormalGL.jpg *Roughness.jpg *Metalness.jpg "
        "*AmbientOcclusion.jpg Metal032.png",
        "height=*Displacement.jpg base_color=*Color.jpg roughness=*Roughness.jpg metallic=*Metalness.jpg "
        "normal=*NormalGL.jpg",
    ),
    "Poly Haven": (
        "brick_wall_001_",
        "*diff_4k.jpg *disp_4k.png *nor_gl_4k.exr *nor_dx_4k.exr *rough_4k.exr *arm_4k.jpg *ao_4k.jpg",
        "height=*disp_4k.png base_color=*diff_4k.jpg roughness=*rough_4k.exr metallic=*arm_4k.jpg[B] "
        "normal=*nor_gl_4k.exr",
    ),
    "Poly Haven, colors": (
        "fabric_07_",
        "*col_2_1k.png *col_1_1k.png *disp_1k.png",
        "height=*disp_1k.png base_color=*col_1_1k.png",
    ),
    "Poliigon": (
        "GroundGrassGreen002_",
        "*AO_1K.jpg *COL_VAR1_1K.jpg *COL_VAR2_1K.jpg *DISP16_3K.tif *DISP_1K.jpg *GLOSS_1K.jpg "
        "*NRM16_1K.tif *NRM_1K.jpg",
        "height=*DISP16_3K.tif base_color=*COL_VAR1_1K.jpg roughness=1-*GLOSS_1K.jpg normal=*NRM16_1K.tif",
    ),
    "Poliigon, two workflows": (
        "MetalBronze001_",
        "*COL_2K_METALNESS.png *COL_2K_SPECULAR.png *DISP_2K_METALNESS.png *DISP16_2K_METALNESS.png "
        "*GLOSS_2K_SPECULAR.png *ROUGHNESS_2K_METALNESS.png *METALNESS_2K_METALNESS.png "
        "*NRM_2K_METALNESS.png *NRM_2K_SPECULAR.png *REFL_2K_SPECULAR.png",
        "height=*DISP16_2K_METALNESS.png base_color=*COL_2K_METALNESS.png "
        "roughness=*ROUGHNESS_2K_METALNESS.png metallic=*METALNESS_2K_METALNESS.png "
        "normal=*NRM_2K_METALNESS.png",
    ),
    "Megascans": (
        "uigjaeoic_2K_",
        "*Albedo.jpg *AO.jpg *Bump.jpg *Cavity.jpg *Displacement.exr *Gloss.jpg *Normal.jpg *NormalBump.jpg "
        "*Roughness.jpg *Opacity.jpg *Diffuse.jpg",
        "height=*Displacement.exr base_color=*Albedo.jpg roughness=*Roughness.jpg normal=*Normal.jpg "
        "opacity=*Opacity.jpg",
    ),
    "FreePBR": (
        "rocky-shoreline1-",
        "*albedo.png *ao.png *height.png *normal-ogl.png *normal-dx.png *roughness.png *metallic.png",
        "height=*height.png base_color=*albedo.png roughness=*roughness.png metallic=*metallic.png "
        "normal=*normal-ogl.png",
    ),
    "Painter": (
        "Mat_",
        "*Base_Color.png *Height.png *Mixed_AO.png *Normal_DirectX.png *Normal_OpenGL.png "
        "*OcclusionRoughnessMetallic.png",
        "height=*Height.png base_color=*Base_Color.png roughness=*OcclusionRoughnessMetallic.png[G] "
        "metallic=*OcclusionRoughnessMetallic.png[B] normal=*Normal_OpenGL.png",
    ),
    "Unity, URP": (
        "Mat_",
        "*AlbedoTransparency.png *MetallicSmoothness.png *Normal.png *Height.png",
        "height=*Height.png base_color=*AlbedoTransparency.png roughness=1-*MetallicSmoothness.png[A] "
        "metallic=*MetallicSmoothness.png[R] normal=*Normal.png opacity=*AlbedoTransparency.png[A]",
    ),
    "Unity, HDRP": (
        "Rock_",
        "*BaseMap.tga *MaskMap.tga *Normal.tga *BentNormalMap.tga *Height.png",
        "height=*Height.png base_color=*BaseMap.tga roughness=1-*MaskMap.tga[A] metallic=*MaskMap.tga[R] "
        "normal=*Normal.tga",
    ),
    "all lower case": (
        "mat_",
        "*normalmap.png *heightmap.png *colormap.png *roughnessmap.png *ambientocclusion.png",
        "height=*heightmap.png base_color=*colormap.png roughness=*roughnessmap.png normal=*normalmap.png",
    ),
}


def in_words(role: str, entry: str | dict[str, Any]) -> str:
    options = {"file": entry} if isinstance(entry, str) else entry
    channel = f"[{options['channel']}]" if "channel" in options else ""
    return f"{role}={'1-' if options.get('invert') else ''}{options['file']}{channel}"


class TestSites:
    @pytest.mark.parametrize("site", SITES)
    def test_what_is_certain_is_used(self, site: str, tmp_path: Path) -> None:
        start, names, expected = SITES[site]
        maps = find_maps(fill(tmp_path, *names.replace("*", start).split()))
        entries = {in_words(role, entry) for role, entry in maps.entries.items()}
        assert entries == set(expected.replace("*", start).split())
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
            *(
                ("x_ARM", "G", "B"),
                ("x_rma", "R", "G"),
                ("x_MRAO", "G", "R"),
                ("x_RoughnessMetallicAO", "R", "G"),
            ),
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

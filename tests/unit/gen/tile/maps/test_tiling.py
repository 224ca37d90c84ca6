"""Maps that do not tile are found, and mirrored or blended alike; normals keep the right signs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.height_maps import Floats, fractal, normals_of, save_heights, save_normals

from mbtf_core.errors import InputError
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_gen.tile.loading import load_material
from mbtf_gen.tile.maps.normal_map import fit_normals
from mbtf_gen.tile.maps.tiling import broken, mirror, mirror_normals, seams


def cut(height: Floats) -> Floats:
    """Three quarters of a tile: it does not tile any more."""
    rows, columns = height.shape[:2]
    return np.ascontiguousarray(height[: 3 * rows // 4, : 3 * columns // 4])


class TestSeams:
    @pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 3.0])
    @pytest.mark.parametrize("shape", [(64, 64), (64, 160)])
    def test_periodic_maps_have_none(self, shape: tuple[int, int], exponent: float) -> None:
        height = fractal(*shape, exponent)
        for shift in range(0, shape[1], 16):
            for seam in seams(np.roll(height, (shift, shift), (0, 1))):
                assert not broken(seam), seam

    @pytest.mark.parametrize("exponent", [1.5, 2.0, 3.0])
    def test_cut_maps_have_both(self, exponent: float) -> None:
        along_u, along_v = seams(cut(fractal(128, 128, exponent)))
        assert (along_u.axis, along_v.axis) == ("u", "v")
        assert broken(along_u)
        assert broken(along_v)

    def test_rounding_makes_no_seam(self) -> None:
        """One code of difference on an otherwise flat map is rounding."""
        height = np.zeros((32, 300))
        height[:, :50] = 1 / 255
        assert broken(seams(height)[0])
        assert not broken(seams(height, 1 / 255)[0])


def test_normals_follow_the_mirrored_heights() -> None:
    height = cut(fractal(96, 128))
    expected = normals_of(mirror(height), 0.025)
    # Central differences across a mirror's edge see another slope there than inside the old map.
    got = mirror_normals(normals_of(height, 0.05).astype(np.float32))
    inner = np.ones(expected.shape[:2], bool)
    for axis in (0, 1):
        size = height.shape[axis]
        for line in (0, size - 1, size, 2 * size - 1):
            np.moveaxis(inner, axis, 0)[line] = False
    assert np.abs(got - expected)[inner].max() < 1e-6


class TestMaterial:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        height = fractal(96, 128)
        save_heights(tmp_path / "height.png", cut(height))
        save_normals(tmp_path / "normal_dx.png", cut(normals_of(height, 0.06)), dx=True)
        save_heights(tmp_path / "rough.png", cut(fractal(48, 64)), 8)
        np.save(tmp_path / "color.npy", np.random.default_rng(0).random((72, 96, 3)))
        (tmp_path / "material.yaml").write_text(
            "height: height.png\nnormal: normal_dx.png\nroughness: rough.png\nbase_color: color.npy\n"
            "opacity: {file: color.npy, channel: G}\nsheen_color: color.npy\n"
            + "".join(f"{name}: rough.png\n" for name in ("clearcoat", "clearcoat_roughness", "sheen"))
        )
        return tmp_path

    def test_a_seam_warns_once(self, folder: Path) -> None:
        (warning,) = load_material(folder).warnings
        assert "height.png: does not tile along u and v: the seam is a step of 0.0" in warning
        assert "--make-tileable mirror" in warning
        assert load_material(folder, "mirror").warnings == ()

    def test_mirror_treats_all_maps_alike(self, folder: Path) -> None:
        plain, mirrored = load_material(folder), load_material(folder, "mirror")
        assert mirrored.height.shape == (144, 192)
        shapes = dict.fromkeys(("roughness", "clearcoat", "clearcoat_roughness", "sheen"), (72, 96))
        shapes |= {"sheen_color": (144, 192, 3), "base_color": (144, 192, 3), "opacity": (144, 192)}
        assert {name: np.shape(mirrored.maps[name]) for name in shapes} == shapes
        # The same heights: the tile is twice as wide, so heights in tile widths are half.
        assert mirrored.at(0.3, 192).thickness == pytest.approx(0.5 * plain.at(0.3, 96).thickness)
        assert mirrored.aspect == plain.aspect
        assert "normal" in mirrored.maps
        found = fit_normals(mirrored.height, mirrored.maps["normal"])
        assert found.convention == "gl"
        assert min(found.correlation_u, found.correlation_v) > 0.97
        # Stored heights are halved with the tile's width: the factor of the cut map's own width stays.
        assert found.scale == pytest.approx(0.06 * 4 / 3, rel=0.05)

    def test_blend_treats_all_maps_alike(self, folder: Path) -> None:
        plain, blended = load_material(folder), load_material(folder, "blend")
        names = "height roughness base_color opacity normal clearcoat sheen sheen_color"
        for name in names.split():
            before, after = plain.images[name], blended.images[name]
            assert np.shape(after) == np.shape(before)
            rows, columns = np.shape(before)[:2]
            assert np.abs(after - before)[rows // 2, columns // 2].max() < 1e-6
            assert np.abs(after - before)[0].max() > 0.01

    def test_what_cannot_be_mirrored_is_refused(self, folder: Path) -> None:
        (folder / "material.yaml").write_text(
            "height: height.png\nbsdf: {type: diffuse, reflectance: {type: bitmap, filename: rough.png}}\n"
        )
        assert isinstance(load_material(folder), HeightFieldTile)
        with pytest.raises(InputError, match="textures of its bsdf"):
            load_material(folder, "mirror")

    def test_size_is_bounded(self, folder: Path) -> None:
        with pytest.raises(InputError, match="more than 27,647 pixels"):
            load_material(folder, "mirror", 4 * 72 * 96 - 1)
        assert load_material(folder, "blend", 4 * 72 * 96 - 1).height.shape == (72, 96)
        with pytest.raises(InputError, match="96 x 72 pixels; at most 6,911"):
            load_material(folder, max_pixels=72 * 96 - 1)

"""A normal map is compared with its heights: convention, orientation and scale, or no finding."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.height_maps import Floats, fractal, normals_of, save_heights, save_normals
from support.paths import ROOT

from mbtf_core.images.read import gray, read_image
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_gen.tile.loading import load_material
from mbtf_gen.tile.maps.normal_map import fit_normals

ASSET = ROOT / "assets/turtle_shell/height.exr"


@pytest.mark.parametrize("kind", ["fractal", "asset"])
@pytest.mark.parametrize("green", [1, -1])
def test_convention_and_scale(kind: str, green: int) -> None:
    height = fractal(96, 96) if kind == "fractal" else np.asarray(gray(read_image(ASSET))[0], np.float64)
    found = fit_normals(height, normals_of(height, 0.07) * [1, green, 1])
    assert found.fits
    assert not found.inverted
    assert found.convention == ("gl" if green == 1 else "dx")
    assert found.scale == pytest.approx(0.07, rel=1e-3)
    assert found.correlation_u == pytest.approx(1.0, abs=1e-3)
    assert found.correlation_v == pytest.approx(green, abs=1e-3)
    assert found.as_is == pytest.approx(1.0, abs=1e-3)


class TestNoFinding:
    def test_flat(self) -> None:
        up = np.zeros((32, 32, 3))
        up[..., 2] = 1
        assert fit_normals(fractal(32, 32), up) is None
        assert fit_normals(np.zeros((32, 32)), normals_of(fractal(32, 32), 0.1)) is None

    @pytest.mark.parametrize("size", [4, 8, 16, 64])
    def test_chance(self, size: int) -> None:
        """Unrelated noise never counts as a fit or as inverted."""
        for seed in range(20):
            a, b = (fractal(size, size, 0.0, 100 * seed + k) for k in range(2))
            found = fit_normals(a, normals_of(b, 0.1))
            assert not found.fits
            assert not found.inverted
            assert found.convention is None

    def test_ridges_have_no_convention(self) -> None:
        """Slopes along u only: the green channel is empty."""
        ridges = np.tile(fractal(64, 64)[:1], (64, 1))
        found = fit_normals(ridges, normals_of(ridges, 0.05))
        assert found.fits
        assert found.convention is None


class TestMaterial:
    """Notes and warnings of a loaded material."""

    def folder(self, tmp_path: Path, height: Floats, name: str, *, dx: bool) -> Path:
        save_heights(tmp_path / "height.png", height)
        save_normals(tmp_path / name, normals_of(fractal(96, 96), 0.05), dx=dx)
        return tmp_path

    @pytest.mark.parametrize("dx", [False, True])
    @pytest.mark.parametrize("name", ["normal.png", "normal_gl.png", "normal_dx.png"])
    def test_the_pixels_decide_and_a_wrong_name_warns(self, tmp_path: Path, name: str, dx: bool) -> None:
        material = load_material(self.folder(tmp_path, fractal(96, 96), name, dx=dx))
        convention = "dx" if dx else "gl"
        assert material.normal_convention == convention
        assert np.abs(material.maps["normal"] - normals_of(fractal(96, 96), 0.05)).max() < 0.02
        wrong = "_" in name and convention not in name
        assert ["the name implies" in warning for warning in material.warnings] == [True] * wrong

    def test_inverted_heights_warn(self, tmp_path: Path) -> None:
        folder = self.folder(tmp_path, 1 - fractal(96, 96), "normal.png", dx=False)
        (warning,) = load_material(folder).warnings
        assert "upside down" in warning


class TestTwoChannels:
    """Maps without z: the normals, and the height scale that they suggest, are those of the whole map."""

    SCALE = 0.15

    def stored(self) -> NDArray[np.uint8]:
        return np.rint((normals_of(fractal(64, 64), self.SCALE) + 1) * 127.5).astype(np.uint8)

    def material(self, folder: Path, codes: NDArray[np.uint8], name: str = "normal.png") -> HeightFieldTile:
        from PIL import Image as Pillow

        save_heights(folder / "height.png", fractal(64, 64))
        Pillow.fromarray(codes).save(folder / name)
        return load_material(folder)

    def check(self, material: HeightFieldTile) -> None:
        (warning,) = material.warnings
        assert "√(1 - x² - y²)" in warning
        expected = normals_of(fractal(64, 64), self.SCALE)
        assert np.abs(material.maps["normal"] - expected).max() < 0.02
        assert material.normal_fit.scale == pytest.approx(self.SCALE, rel=0.01)

    @pytest.mark.parametrize("kind", ["blue 0", "blue 255", "height in blue", "x in alpha", "gray and alpha"])
    def test_codes(self, tmp_path: Path, kind: str) -> None:
        x, y, _ = np.moveaxis(self.stored(), -1, 0)
        height = (255 * fractal(64, 64, seed=8)).astype(np.uint8)
        channels = {
            "blue 0": (x, y, 0 * x),
            "blue 255": (x, y, 0 * x + 255),
            "height in blue": (x, y, height),
            "x in alpha": (y, y, y, x),
            "gray and alpha": (y, x),
        }
        self.check(self.material(tmp_path, np.dstack(channels[kind])))

    def test_jpg(self, tmp_path: Path) -> None:
        """Its rounding of a whole map is not taken for a missing z."""
        from PIL import Image as Pillow

        save_heights(tmp_path / "height.png", fractal(64, 64))
        for scale, quality in ((0.005, 50), (0.05, 75), (0.5, 95)):
            codes = np.rint((normals_of(fractal(64, 64), scale) + 1) * 127.5).astype(np.uint8)
            Pillow.fromarray(codes).save(tmp_path / "normal.jpg", quality=quality)
            assert not any("√" in warning for warning in load_material(tmp_path).warnings)

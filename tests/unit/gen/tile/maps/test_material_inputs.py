"""What users bring: packed and layered maps, encodings, numbers that leave [0, 1], names slightly wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.image_files import exr, png, rng

from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import InputError
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_gen.tile.loading import load_material


def write(folder: Path, text: str) -> Path:
    path = folder / "material.yaml"
    path.write_text(text)
    return path


@pytest.fixture
def heights(tmp_path: Path) -> Path:
    np.save(tmp_path / "height.npy", 0.1 * rng().random((8, 16)))
    return tmp_path


def test_color_is_refused_with_the_way_out(tmp_path: Path) -> None:
    codes = rng().integers(0, 256, (8, 8, 3))
    path = png(tmp_path / "height.png", codes, 2, 8)
    with pytest.raises(InputError, match=r"height\.png: is colored; a height map is gray") as caught:
        load_material(path)
    assert "channel: R" in caught.value.hint
    text = "height: {file: height.png, channel: G, dequantize: false}\n"
    material = load_material(write(tmp_path, text))
    assert np.array_equal(np.rint(material.height * 255), codes[..., 1])


def test_the_option_decides(tmp_path: Path) -> None:
    names = ("R", "G", "B", "displacement.Y", "extra.Y")
    stored = {n: (rng().random((6, 9)) / (i + 1)).astype(np.float32) for i, n in enumerate(names)}
    exr(tmp_path / "all.exr", stored)
    path = write(tmp_path, "height: {file: all.exr, channel: extra.Y}\nbase_color: all.exr\n")
    material = load_material(path)
    assert np.array_equal(material.height, stored["extra.Y"])
    assert np.array_equal(material.maps["base_color"], np.stack([stored[c] for c in "RGB"], axis=-1))


class TestScalars:
    def test_gloss_is_inverted_roughness(self, heights: Path) -> None:
        codes = rng().integers(0, 65536, (8, 16, 1))
        png(heights / "gloss.png", codes, 0, 16)
        texts = {
            "invert: true": 1 - codes[..., 0] / 65535,
            "colorspace: srgb": srgb_to_linear(codes[..., 0] / 65535),
            "invert: false": codes[..., 0] / 65535,
            "colorspace: srgb, invert: true": 1 - srgb_to_linear(codes[..., 0] / 65535),
        }
        digests = set()
        for option, expected in texts.items():
            text = f"height: height.npy\nroughness: {{file: gloss.png, {option}}}\n"
            material = load_material(write(heights, text))
            assert material.maps["roughness"] == pytest.approx(expected)
            digests.add(material.digests["settings"])
        assert len(digests) == len(texts)

    def test_a_mask_map_is_metallic_and_smoothness(self, heights: Path) -> None:
        codes = rng().integers(0, 256, (8, 16, 4))
        path = png(heights / "Rock_MaskMap.png", codes, 6, 8)
        material = load_material(heights)
        assert np.array_equal(np.rint(255 * np.asarray(material.maps["metallic"])), codes[..., 0])
        assert np.array_equal(np.rint(255 * (1 - np.asarray(material.maps["roughness"]))), codes[..., 3])
        assert "opacity" not in material.maps
        assert material.warnings == ()
        png(path, codes[..., :3], 2, 8)
        assert "no alpha channel" in load_material(heights).warnings[0]

    def test_a_mask(self, heights: Path) -> None:
        codes = rng().integers(0, 256, (8, 16, 4))
        png(heights / "rock_mask.png", codes, 6, 8)
        with pytest.raises(InputError, match="an opacity map is gray"):
            load_material(heights)
        png(heights / "rock_mask.png", codes[..., :1], 0, 8)
        material = load_material(heights)
        assert np.array_equal(np.rint(255 * np.asarray(material.maps["opacity"])), codes[..., 0])
        assert any("'mask'" in warning for warning in material.warnings)


class TestColor:
    def color(self, folder: Path, option: str, *chunks: tuple[bytes, bytes]) -> HeightFieldTile:
        self.codes = rng().integers(0, 256, (8, 16, 3))
        png(folder / "c.png", self.codes, 2, 8, extra=chunks)
        return load_material(write(folder, f"height: height.npy\nbase_color: {{file: c.png{option}}}\n"))

    def test_integers_are_srgb_by_default(self, heights: Path) -> None:
        linear_chunk = (b"gAMA", (100000).to_bytes(4, "big"))
        cases = {
            ("", ()): True,
            (", colorspace: linear", ()): False,
            ("", (linear_chunk,)): False,
            (", colorspace: srgb", (linear_chunk,)): True,
        }
        for (option, chunks), bent in cases.items():
            material = self.color(heights, option, *chunks)
            expected = self.codes / 255
            expected = np.asarray(srgb_to_linear(expected)) if bent else expected
            assert np.abs(material.maps["base_color"] - expected).max() < 1e-6, (option, chunks)


def test_backslashes_separate(heights: Path) -> None:
    codes = rng().integers(0, 256, (8, 16, 1))
    (heights / "maps").mkdir()
    png(heights / "maps" / "rough.png", codes, 0, 8)
    path = write(heights, "height: height.npy\nroughness: maps\\rough.png\n")
    expected = {"height": "height.npy", "roughness": "maps/rough.png"}
    files = load_material(path).files
    assert {role: file.relative_to(heights).as_posix() for role, file in files.items()} == expected


ACESCG = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    np.save(tmp_path / "height.npy", 0.1 * rng().random((32, 32)))
    return tmp_path


def stripes(low: float = 0.0, high: float = 1.0) -> np.ndarray:
    return np.where(np.arange(32 * 32).reshape(32, 32) // 3 % 2, high, low).astype(np.float16)


@pytest.mark.parametrize("compression", ["DWAA", "DWAB"])
def test_lossy_exr_is_clamped_with_one_warning(folder: Path, compression: str) -> None:
    import OpenEXR

    head = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION")}
    rough = exr(folder / "rough.exr", {"Y": stripes()}, **head)
    exr(folder / "diff.exr", {name: stripes(0.0, 0.02) for name in "RGB"}, **head)
    (stored,) = OpenEXR.File(str(rough), separate_channels=True).parts[0].channels.values()
    outside = (stored.pixels > 1) | (stored.pixels < 0)
    assert outside.any()
    material = load_material(folder)
    assert material.maps["roughness"] == pytest.approx(np.clip(stored.pixels, 0, 1))
    assert material.maps["base_color"].min() >= 0
    (warning,) = (w for w in material.warnings if "rough.exr" in w)
    assert f"{outside.sum()} pixels" in warning
    assert f"{float(np.max(stored.pixels)) - 1:.2g}" in warning
    assert compression in warning


@pytest.mark.parametrize(
    ("compression", "dtype", "number", "read"),
    [
        ("ZIP", np.float16, 1 + 2**-10, True),
        ("ZIP", np.float16, 1 + 2**-9, False),
        ("NO", np.float32, -0.01, False),
        ("PXR24", np.float32, 1 + 2**-15, True),
        ("B44", np.float16, -1e-5, True),
        ("B44", np.float16, 1.01, False),
        ("DWAA", np.float16, 1.5, False),
    ],
)
def test_the_tolerance_depends_on_the_compression(
    folder: Path, compression: str, dtype: type, number: float, read: bool
) -> None:
    import OpenEXR

    numbers = np.full((32, 32), number, dtype)
    exr(folder / "rough.exr", {"Y": numbers}, compression=getattr(OpenEXR, f"{compression}_COMPRESSION"))
    if read:
        material = load_material(folder)
        assert np.all(material.maps["roughness"] == np.clip(number, 0, 1))
        assert any("1024 pixels" in w and "clamped" in w for w in material.warnings)
    else:
        with pytest.raises(InputError, match=r"1024 pixels.* outside") as caught:
            load_material(folder)
        assert "clamp" in caught.value.hint


def test_primaries_matter_for_colors_only(folder: Path) -> None:
    numbers = rng().uniform(0.3, 0.6, (32, 32)).astype(np.float32)
    exr(folder / "diff.exr", {"R": 2 * numbers - 0.2, "G": numbers, "B": numbers}, chromaticities=ACESCG)
    exr(folder / "rough.exr", {"Y": numbers}, chromaticities=ACESCG)
    material = load_material(folder)
    assert np.array_equal(material.maps["roughness"], numbers.astype(float))
    # Red by the published matrix, 1.70505 R - 0.62179 G - 0.08326 B, clamped.
    red = 1.70505 * (2 * numbers - 0.2) - 0.70505 * numbers
    assert material.maps["base_color"][..., 0] == pytest.approx(np.clip(red, 0, 1), abs=1e-4)
    (warning,) = material.warnings
    assert f"{int((red > 1.001).sum())} pixels" in warning
    assert "ACEScg" in warning
    assert "ACEScg" in material.facts["base_color"].colorspace

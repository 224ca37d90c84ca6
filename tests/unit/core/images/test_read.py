"""Images decode to exact numbers, of every kind; unusable ones are refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from support.image_files import exr, png, rng

from mbtf_core.errors import InputError
from mbtf_core.images.read import Image, gray, read_image


@pytest.mark.parametrize(("color", "channels"), [(0, 1), (4, 2), (2, 3), (6, 4)])
@pytest.mark.parametrize("bits", [8, 16])
def test_png_keeps_every_code(tmp_path: Path, color: int, channels: int, bits: int) -> None:
    largest = 2**bits - 1
    codes = rng().integers(0, largest + 1, (11, 7, channels))
    codes[0, 0], codes[0, 1] = 0, largest
    image = read_image(png(tmp_path / "x.png", codes, color, bits))
    assert image.bits == bits
    assert image.pixels.shape == (11, 7, channels)
    assert np.array_equal(np.rint(image.pixels.astype(np.float64) * largest), codes)
    assert image.pixels.max() == 1.0
    if channels == 1:
        assert np.array_equal(image.pixels, codes / largest)


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_palettes_and_single_bits(suffix: str, tmp_path: Path) -> None:
    from PIL import Image as Pillow

    codes = rng().integers(0, 4, (5, 6)).astype(np.uint8)
    palette = np.array([[0, 0, 0], [255, 10, 20], [30, 40, 50], [255, 255, 255]], np.uint8)
    picture = Pillow.fromarray(codes)
    picture.putpalette(palette.tobytes())
    picture.save(tmp_path / f"x.{suffix}")
    image = read_image(tmp_path / f"x.{suffix}")
    assert image.bits == 8
    assert np.array_equal(np.rint(image.pixels * 255), palette[codes])
    picture.save(tmp_path / "y.png", transparency=2)
    assert np.array_equal(read_image(tmp_path / "y.png").pixels[..., 3] == 0.0, codes == 2)
    mask = rng().random((5, 9)) < 0.5
    Pillow.fromarray(mask).save(tmp_path / f"b.{suffix}")
    assert np.array_equal(read_image(tmp_path / f"b.{suffix}").pixels[..., 0], mask.astype(float))


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_exr(tmp_path: Path, dtype: type) -> None:
    numbers = (100 * rng().normal(size=(5, 6, 4))).astype(dtype)
    r, g, b, a = (np.ascontiguousarray(numbers[..., i]) for i in range(4))
    one = read_image(exr(tmp_path / "y.exr", {"displacement.height": r}))
    assert one.bits is None
    assert np.array_equal(one.pixels[..., 0], r)
    rgb = read_image(exr(tmp_path / "rgb.exr", {"R": r, "G": g, "B": b}))
    assert np.array_equal(rgb.pixels, numbers[..., :3])
    rgba = read_image(exr(tmp_path / "rgba.exr", {"R": r, "G": g, "B": b, "A": a, "depth.Z": a}))
    assert np.array_equal(rgba.pixels, numbers)
    layer = read_image(exr(tmp_path / "layer.exr", {"albedo.R": r, "albedo.G": g, "albedo.B": b}))
    assert np.array_equal(layer.pixels, numbers[..., :3])
    with pytest.raises(InputError, match=r"unclear: p, q"):
        read_image(exr(tmp_path / "pq.exr", {"p": r, "q": g}))


def test_npy(tmp_path: Path) -> None:
    numbers = rng().normal(size=(5, 6))
    np.save(tmp_path / "d.npy", numbers)
    assert np.array_equal(read_image(tmp_path / "d.npy").pixels[..., 0], numbers)
    np.save(tmp_path / "t.npy", np.asfortranarray(numbers.astype(">f4")))
    assert np.array_equal(read_image(tmp_path / "t.npy").pixels[..., 0], numbers.astype(np.float32))
    for dtype, bits in ((np.uint8, 8), (np.uint16, 16)):
        codes = rng().integers(0, 2**bits, (5, 6, 3)).astype(dtype)
        np.save(tmp_path / "i.npy", codes)
        image = read_image(tmp_path / "i.npy")
        assert image.bits == bits
        assert np.array_equal(np.rint(image.pixels.astype(np.float64) * (2**bits - 1)), codes)
    refused = {"int64 numbers": np.zeros((5, 6), np.int64), r"shape \(5, 6, 7\)": np.zeros((5, 6, 7))}
    for message, array in {**refused, "npy": np.array([[None]])}.items():
        np.save(tmp_path / "w.npy", array, allow_pickle=True)
        with pytest.raises(InputError, match=message):
            read_image(tmp_path / "w.npy")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite_are_counted_and_placed(tmp_path: Path, value: float) -> None:
    numbers = np.zeros((4, 6), np.float32)
    numbers[2, 5] = numbers[3, 0] = value
    with pytest.raises(InputError, match=r"x\.exr: 2 pixels, the first at column 5, row 2, are NaN or inf"):
        read_image(exr(tmp_path / "x.exr", {"Y": numbers}))


def good_files(folder: Path) -> list[Path]:
    """One good file of every kind, of noise, so that cutting it anywhere loses pixels."""
    from PIL import Image as Pillow

    codes = rng().integers(0, 256, (64, 64, 3)).astype(np.uint8)
    Pillow.fromarray(codes).save(folder / "a.png")
    Pillow.fromarray(codes).save(folder / "a.jpg")
    Pillow.fromarray(codes).save(folder / "a.tif")
    Pillow.fromarray(codes).save(folder / "a.tga")
    Pillow.fromarray(codes).save(folder / "b.tga", compression="tga_rle")
    png(folder / "deep.png", rng().integers(0, 65536, (64, 64, 3)), 2, 16)
    np.save(folder / "a.npy", codes)
    exr(folder / "a.exr", {"Y": rng().random((64, 64)).astype(np.float32)})
    return sorted(folder.iterdir())


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9])
def test_truncated_files_are_refused(tmp_path: Path, share: float, capfd: pytest.CaptureFixture[str]) -> None:
    for path in good_files(tmp_path):
        assert read_image(path).shape == (64, 64)
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(InputError) as caught:
            read_image(path)
        assert "\n" not in caught.value.what
        assert str(path) in caught.value.message
    assert capfd.readouterr() == ("", "")


def test_gray_is_exact_for_equal_channels_and_else_the_luminance_with_a_warning() -> None:
    codes = rng().integers(0, 256, (4, 5, 1))
    numbers, warnings = gray(Image(np.repeat(codes, 3, axis=2).astype(np.uint8), Path("x.png")))
    assert np.array_equal(numbers, codes[..., 0] / 255)
    assert warnings == []
    # Rounding of JPG is no color.
    rounded = np.full((4, 5, 3), 100, np.uint8)
    rounded[0, 0, 1] = 102
    assert gray(Image(rounded, Path("x.jpg")))[1] == []
    numbers, (warning,) = gray(Image(np.uint8([[[0, 51, 0]]]), Path("x.png")))
    assert numbers == pytest.approx(0.7152 * 0.2)
    assert "luminance" in warning
    assert "alpha" in gray(Image(np.uint8([[[255, 128]]]), Path("x.png")))[1][0]


class TestTiff:
    @pytest.mark.parametrize("compression", [None, "lzw", "packbits", "zstd"])
    @pytest.mark.parametrize(("channels", "dtype"), [(1, "u1"), (3, "u2"), (4, "f4"), (3, "f2")])
    def test_every_number_is_kept(
        self, tmp_path: Path, compression: str | None, channels: int, dtype: str
    ) -> None:
        noise = rng().random((20, 37, channels))
        stored = (noise * 65535).astype(dtype) if dtype[0] == "u" else (100 * noise - 50).astype(dtype)
        extra: dict[str, Any] = {"extrasamples": ["unassalpha"]} if channels == 4 else {}
        extra["photometric"] = "minisblack" if channels == 1 else "rgb"
        pixels = stored if channels > 1 else stored[..., 0]
        tifffile.imwrite(tmp_path / "x.tif", pixels, compression=compression, **extra)
        image = read_image(tmp_path / "x.tif")
        assert image.bits == {"u1": 8, "u2": 16}.get(dtype)
        scale = 2**image.bits - 1 if image.bits else 1
        assert np.array_equal(np.rint(image.pixels * scale) if image.bits else image.pixels, stored)

    def test_tiles_and_planes(self, tmp_path: Path) -> None:
        codes = rng().integers(0, 65536, (70, 50, 3)).astype(np.uint16)
        tifffile.imwrite(tmp_path / "tiled.tif", codes, tile=(32, 16), compression="lzw", photometric="rgb")
        planes = np.moveaxis(codes, -1, 0)
        tifffile.imwrite(tmp_path / "planes.tif", planes, photometric="rgb", planarconfig="separate")
        for name in ("tiled.tif", "planes.tif"):
            assert np.array_equal(np.rint(read_image(tmp_path / name).pixels.astype(float) * 65535), codes)

    @pytest.mark.parametrize("dtype", ["u1", "u2"])
    def test_white_may_be_zero(self, tmp_path: Path, dtype: str) -> None:
        stored = rng().integers(0, np.iinfo(dtype).max, (6, 8)).astype(dtype)
        tifffile.imwrite(tmp_path / "x.tif", stored, photometric="miniswhite")
        largest = np.iinfo(dtype).max
        assert np.array_equal(read_image(tmp_path / "x.tif").pixels[..., 0], (largest - stored) / largest)


def test_several_parts(tmp_path: Path) -> None:
    import OpenEXR

    rough, disp = (rng().random((4, 6)).astype(np.float32) for _ in range(2))
    head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    layers = (("rough", rough), ("disp", disp + 1))
    parts = [OpenEXR.Part({**head, "name": name}, {"Y": y}, name) for name, y in layers]
    OpenEXR.File(parts).write(str(tmp_path / "x.exr"))
    image = read_image(tmp_path / "x.exr", "disp")
    assert np.array_equal(image.pixels[..., 0], disp + 1)
    assert image.channels == ("disp.Y",)
    assert np.array_equal(read_image(tmp_path / "x.exr", "rough.Y").pixels[..., 0], rough)


def test_single_channels_of_other_kinds(tmp_path: Path) -> None:
    codes = rng().integers(0, 65536, (5, 6, 4))
    path = png(tmp_path / "packed.png", codes, 6, 16)
    for index, name in enumerate("RGBA"):
        image = read_image(path, name.lower())
        assert np.array_equal(image.pixels, codes[..., index : index + 1] / 65535)
        assert image.channels == (name,)
    with pytest.raises(InputError, match="no channel 'Y'"):
        read_image(path, "Y")


@pytest.mark.parametrize("compression", [None, "tga_rle"])
@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA"])
def test_tga_keeps_every_code(tmp_path: Path, mode: str, compression: str | None) -> None:
    from PIL import Image as Pillow

    codes = rng().integers(0, 256, (5, 6, len(mode))).astype(np.uint8)
    Pillow.frombytes(mode, (6, 5), codes.tobytes()).save(tmp_path / "x.TGA", compression=compression)
    image = read_image(tmp_path / "x.TGA")
    assert image.bits == 8
    assert np.array_equal(np.rint(255 * image.pixels), codes)

"""Images that need care: TIFF, TGA, parts of EXR, single channels."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from support.image_files import png, rng

from mbtf_core.errors import InputError
from mbtf_core.images.read import read_image


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


class TestLayers:
    def test_several_parts(self, tmp_path: Path) -> None:
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


Codes = NDArray[np.uint8]


def write(path: Path, codes: Codes, origin: int, *, runs: bool, palette: Codes | None = None) -> Path:
    """Codes (H, W, C), gray, gray and alpha, RGB or RGBA, or indices of a palette (n, 3)."""
    rows, columns, channels = codes.shape
    kind = 1 if palette is not None else 3 if channels < 3 else 2
    order = [2, 1, 0, 3][:channels] if channels > 2 else list(range(channels))
    stored = codes[..., order]
    stored = stored if origin & 0x20 else stored[::-1]
    stored = stored[:, ::-1] if origin & 0x10 else stored
    head = struct.pack(
        "<BBBHHBHHHHBB",
        3,  # length of the text behind the header
        int(palette is not None),
        kind + 8 * runs,
        0,
        0 if palette is None else len(palette),
        0 if palette is None else 24,
        *(0, 0, columns, rows),
        8 * channels,
        origin | (8 if channels in (2, 4) else 0),
    )
    table = b"" if palette is None else palette[:, ::-1].tobytes()
    pixels = [bytes(pixel) for line in stored for pixel in line]
    body = b"".join(_runs(pixels)) if runs else b"".join(pixels)
    path.write_bytes(head + b"abc" + table + body)
    return path


def _runs(pixels: list[bytes]) -> list[bytes]:
    """Packets of two pixels: a run where they are equal, else as they are."""
    pairs = zip(pixels[::2], pixels[1::2], strict=True)
    return [b"\x81" + a if a == b else b"\x01" + a + b for a, b in pairs]


@pytest.mark.parametrize("runs", [False, True])
@pytest.mark.parametrize("origin", [0x00, 0x10, 0x20, 0x30])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_every_code_is_in_its_place(tmp_path: Path, channels: int, origin: int, runs: bool) -> None:
    codes = rng().integers(0, 256, (5, 6, channels)).astype(np.uint8)
    codes[2] = codes[2, :1]  # runs
    image = read_image(write(tmp_path / "x.tga", codes, origin, runs=runs))
    assert image.bits == 8
    assert np.array_equal(np.rint(255 * image.pixels), codes)


def test_a_palette(tmp_path: Path) -> None:
    palette = rng().integers(0, 256, (4, 3)).astype(np.uint8)
    codes = rng().integers(0, 4, (5, 6, 1)).astype(np.uint8)
    image = read_image(write(tmp_path / "x.TGA", codes, 0, runs=True, palette=palette))
    assert np.array_equal(np.rint(255 * image.pixels), palette[codes[..., 0]])

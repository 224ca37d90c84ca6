"""Small files of every image format that is read, in their many kinds."""

from __future__ import annotations

import io
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

ROWS, COLUMNS = 5, 7


def _random(channels: int, dtype: type = np.uint8) -> np.ndarray:
    largest = np.iinfo(dtype).max
    return np.random.default_rng(channels).integers(0, largest, (ROWS, COLUMNS, channels)).astype(dtype)


def _saved(picture: Image.Image, kind: str, **options: object) -> bytes:
    stream = io.BytesIO()
    picture.save(stream, kind, **options)
    return stream.getvalue()


def pictures() -> dict[str, Image.Image]:
    """Pictures by kind of pixel."""
    color, alpha, cmyk = (Image.fromarray(_random(3)), Image.fromarray(_random(4)), _random(4))
    return {
        "L": Image.fromarray(_random(1)[..., 0]),
        "LA": Image.fromarray(_random(4)).convert("LA"),
        "RGB": color,
        "RGBA": alpha,
        "P": color.quantize(16),
        "1": color.convert("1"),
        "I;16": Image.fromarray(_random(1, np.uint16)[..., 0]),
        "F": Image.fromarray(np.random.default_rng(0).random((ROWS, COLUMNS)).astype(np.float32)),
        "CMYK": Image.merge("CMYK", [Image.fromarray(cmyk[..., c]) for c in range(4)]),
    }


def png_chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk of a PNG file with its checksum."""
    return len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")


def packed_png(
    columns: int, rows: int, bits: int, color: int, packed: bytes, *extra: tuple[bytes, bytes]
) -> bytes:
    """A PNG file around compressed lines; `extra` chunks stand before them."""
    size = columns.to_bytes(4, "big") + rows.to_bytes(4, "big")
    head = png_chunk(b"IHDR", size + bytes([bits, color, 0, 0, 0]))
    chunks = b"".join(png_chunk(*chunk) for chunk in extra)
    return b"\x89PNG\r\n\x1a\n" + head + chunks + png_chunk(b"IDAT", packed) + png_chunk(b"IEND", b"")


def _png16() -> bytes:
    lines = b"".join(bytes([y]) + bytes((37 * x + y) % 256 for x in range(6 * COLUMNS)) for y in range(ROWS))
    return packed_png(COLUMNS, ROWS, 16, 2, zlib.compress(lines))


def tgas() -> dict[str, bytes]:
    """TGA files by name, with and without run lengths."""
    kinds = [name for name in pictures() if name in ("L", "LA", "RGB", "RGBA", "P")]
    runs: list[dict[str, object]] = [{}, {"compression": "tga_rle"}]
    return {f"{name}{len(run)}.tga": _saved(pictures()[name], "TGA", **run) for name in kinds for run in runs}


def bmps() -> dict[str, bytes]:
    """BMP files by name."""
    kinds = [name for name in pictures() if name in ("L", "RGB", "RGBA", "P", "1")]
    return {f"{name}.bmp": _saved(pictures()[name], "BMP") for name in kinds}


def pngs() -> dict[str, bytes]:
    """PNG files by name."""
    kinds = ("L", "LA", "RGB", "RGBA", "P", "1", "I;16")
    out = {f"{kind}.png": _saved(p, "PNG") for kind, p in pictures().items() if kind in kinds}
    return {**out, "RGB16.png": _png16()}


def jpgs() -> dict[str, bytes]:
    """JPG files by name."""
    found = pictures()
    out = {f"{kind}.jpg": _saved(found[kind], "JPEG") for kind in ("L", "RGB", "CMYK")}
    return {**out, "progressive.jpg": _saved(found["RGB"], "JPEG", progressive=True)}


def tiffs() -> dict[str, bytes]:
    """TIFF files by name: kinds of pixels and compressions."""
    out = {}
    for kind, picture in pictures().items():
        for compression in ("raw", "tiff_lzw", "tiff_adobe_deflate", "packbits"):
            out[f"{kind}-{compression}.tif"] = _saved(picture, "TIFF", compression=compression)
    out["RGB-jpeg.tif"] = _saved(pictures()["RGB"], "TIFF", compression="jpeg")
    out["RGB-big.tif"] = _saved(pictures()["RGB"], "TIFF", big_tiff=True)
    out["1-group4.tif"] = _saved(pictures()["1"], "TIFF", compression="group4")
    return out


def npys() -> dict[str, bytes]:
    """NPY files by name: kinds of numbers and versions of the format."""
    out = {}
    for dtype in ("<f4", ">f8", "<f2", "<u2", "|u1", "<i8"):
        for version in ((1, 0), (2, 0), (3, 0)):
            stream = io.BytesIO()
            np.lib.format.write_array(stream, _random(3).astype(dtype), version=version)
            out[f"{dtype[1:]}-{version[0]}.npy"] = stream.getvalue()
    return out


def exrs(folder: Path) -> dict[str, bytes]:
    """EXR files by name: compressions, lines and tiles, half and float, several parts."""
    import OpenEXR

    pixels = np.random.default_rng(0).random((20, 24)).astype(np.float32)
    path, out = folder / "sample.exr", {}
    for name in ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"):
        for kind in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
            header = {"compression": getattr(OpenEXR, f"{name}_COMPRESSION"), "type": kind}
            if kind == OpenEXR.tiledimage:
                header["tiles"] = OpenEXR.TileDescription()
                header["tiles"].xSize = header["tiles"].ySize = 8
            number = np.float16 if kind == OpenEXR.tiledimage else np.float32
            channels = {c: pixels.astype(number) for c in "RGB"}
            OpenEXR.File(header, channels).write(str(path))
            out[f"{name}-{kind.name}.exr"] = path.read_bytes()
    parts = [OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"Y": pixels + i}, f"part{i}") for i in range(2)]
    OpenEXR.File(parts).write(str(path))
    return {**out, "parts.exr": path.read_bytes()}

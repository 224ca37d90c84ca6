"""Images as arrays: EXR, PNG, JPG, TIFF, TGA, BMP and npy, decoded without loss.

Integer images become ``code / largest code``; float images keep their numbers. Color spaces are applied on
request (:func:`linear_rgb`), as the material decides which maps are colors.
"""

from __future__ import annotations

import contextlib
import tempfile
import warnings as python_warnings
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import InputError, reason
from mbtf_core.images.color_spaces import ColorSpace, srgb
from mbtf_core.images.exr import check_floats, choose_channels, lossy_excess, read_layers, silenced
from mbtf_core.images.limits import MAX_PIXELS, check_size
from mbtf_core.images.tags import NO_TAGS, Tags, exr_tags, pillow_tags
from mbtf_core.images.tiff import read_tiff
from mbtf_core.paths import opened

# Gray images stored as color JPG come back with channels that differ by rounding.
_GRAY_CODES = 2
# Scans of a JPG, which take time for the whole picture each; progressive ones have about ten.
_MOST_SCANS = 100
# Rows of pixels that are converted at a time.
_ROWS = 256

# Rec.709 luminance of linear RGB.
LUMINANCE = (0.2126, 0.7152, 0.0722)

_KINDS = {
    ".exr": "EXR",
    ".png": "PNG",
    ".jpg": "JPEG",
    ".jpeg": "JPEG",
    ".tif": "TIFF",
    ".tiff": "TIFF",
    ".tga": "TGA",
    ".bmp": "BMP",
    ".npy": "NPY",
}
_MAGIC = {
    b"\x76\x2f\x31\x01": "EXR",
    b"\x89PNG": "PNG",
    b"\xff\xd8\xff": "JPEG",
    b"II*\x00": "TIFF",
    b"MM\x00*": "TIFF",
    b"II+\x00": "TIFF",
    b"MM\x00+": "TIFF",
    b"BM": "BMP",
    b"\x93NUMPY": "NPY",
}
# Compressions of BMP, whose decoder is slow and fills whatever a small file leaves out.
_RUN_LENGTHS = (1, 2)
# Channels of 16-bit colors by Pillow's name of them, of which it keeps the upper eight bits.
_DEEP_PNG = {"RGB;16B": 3, "LA;16B": 2, "RGBA;16B": 4}
SUFFIXES = tuple(_KINDS)


@dataclass(frozen=True)
class Image:
    """A decoded image.

    Attributes
    ----------
    stored : (H, W, C) uint8, uint16 or float array; row 0 is the top; C = 1 gray, 2 gray and alpha, 3 RGB, 4
        RGBA; all finite
    path : the file
    tags : what the file declares; not applied here
    channels : names of the selected channels; empty where the file has no others
    excess, compression : how far lossy compression may move floats out of their range, and its name
    """

    stored: NDArray[Any]
    path: Path
    tags: Tags = NO_TAGS
    channels: tuple[str, ...] = ()
    excess: float = 0.0
    compression: str = ""

    @property
    def bits(self) -> int | None:
        """8 or 16 for integer files, whose pixels are code / largest code; None for floats."""
        return None if self.stored.dtype.kind == "f" else 8 * self.stored.dtype.itemsize

    @property
    def space(self) -> ColorSpace:
        """That of the file if supported, else that of its kind: sRGB for integers, linear for floats."""
        return self.tags.space or ("linear" if self.bits is None else "srgb")

    @property
    def white(self) -> int:
        """The largest code, which is 1; 1 for floats."""
        return 1 if self.bits is None else 2**self.bits - 1

    @cached_property
    def pixels(self) -> NDArray[np.floating[Any]]:
        """(H, W, C) float64 (C = 1) or float32 array of the numbers."""
        dtype = np.float64 if self.stored.shape[2] == 1 else np.float32
        if self.bits is None:
            return self.stored.astype(dtype, copy=False)
        return np.divide(self.stored, self.white, dtype=dtype)

    def linear(self, channels: Sequence[int], encoded: bool = False) -> NDArray[np.float32]:
        """(H, W, C) float32 array of some channels, decoded from sRGB where asked.

        It takes some rows at a time: whole copies of a large image would need gigabytes.
        """
        out = np.empty((*self.shape, len(channels)), np.float32)
        for first in range(0, len(out), _ROWS):
            rows = slice(first, first + _ROWS)
            numbers = self.stored[rows][..., list(channels)] / np.float64(self.white)
            out[rows] = srgb_to_linear(numbers.astype(np.float32)) if encoded else numbers
        return out

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.stored.shape[0], self.stored.shape[1]


def is_image(path: Path) -> bool:
    """Is the suffix that of an image format that can be read?"""
    return path.suffix.lower() in _KINDS


def read_image(
    path: str | Path,
    channel: str | None = None,
    prefer: Callable[[str], bool] | None = None,
    max_pixels: int = MAX_PIXELS,
) -> Image:
    """Decode an EXR, PNG, JPG, TIFF, TGA, BMP or npy file.

    Parameters
    ----------
    channel : a channel or layer of an EXR file; R, G, B, A or Y of other formats
    prefer : as of :func:`~mbtf_core.images.exr.choose_channels`
    max_pixels : larger images are refused

    Raises
    ------
    InputError : the file is missing, empty, damaged, truncated, unsupported, or not of the format of its
        suffix; the channel is missing; or pixels are NaN or infinite
    """
    path = Path(path)
    kind = _kind(path)
    if kind == "EXR":
        image = _from_exr(path, channel, prefer, max_pixels)
    else:
        image = _from_npy(path, max_pixels) if kind == "NPY" else _from_pillow(path, kind, max_pixels)
        image = image if channel is None else _pick(image, channel)
    if image.bits is None and not (finite := np.isfinite(image.stored).all(axis=-1)).all():
        raise InputError(f"{count_and_first(~finite)} NaN or infinite", where=path, hint="fill them first")
    return image


def decode_image(content: bytes, kinds: Container[str], where: Path) -> Image:
    """Decode the bytes of an image file that is not in a file of its own, of accepted formats such as ``PNG``
    and ``JPEG``; `where` it comes from is for messages. Errors are those of :func:`read_image`."""
    kind = next((kind for magic, kind in _MAGIC.items() if content.startswith(magic)), None)
    if kind is None or kind not in kinds:
        raise InputError(f"is no image that is read ({kind or 'unknown data'})", where=where)
    suffix = next(suffix for suffix, name in _KINDS.items() if name == kind)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"image{suffix}"
        path.write_bytes(content)
        try:
            return replace(read_image(path), path=where)
        except InputError as error:
            raise InputError(error.what, where=where, hint=error.hint) from None


def count_and_first(bad: NDArray[np.bool_]) -> str:
    """``3 pixels, the first at column 5, row 2, are`` for a mask (H, W) that is set somewhere."""
    number = int(bad.sum())
    row, column = (int(i) for i in np.argwhere(bad)[0])
    if number == 1:
        return f"1 pixel, at column {column}, row {row}, is"
    return f"{number} pixels, the first at column {column}, row {row}, are"


def _kind(path: Path) -> str:
    """Format of a file by its first bytes, which must agree with its suffix."""
    named = _KINDS.get(path.suffix.lower())
    if path.is_dir():
        raise InputError("is a folder, not an image", where=path)
    with opened(path, is_image) as stream:
        start = stream.read(8)
    if named is None:
        raise InputError(
            f"'{path.suffix}' is not an image format that is read",
            where=path,
            hint=f"use one of {', '.join(SUFFIXES)}",
        )
    if not start:
        raise InputError("is empty", where=path)
    # A TGA file has no first bytes of its own.
    unmarked = "TGA" if named == "TGA" else None
    found = next((kind for magic, kind in _MAGIC.items() if start.startswith(magic)), unmarked)
    if found is None:
        raise InputError(f"is not a valid {named} image", where=path)
    if found != named:
        suffix = next(s for s, kind in _KINDS.items() if kind == found)
        raise InputError(f"contains {found} data", where=path, hint=f"rename it to {path.stem}{suffix}")
    return found


def _decoded(numbers: NDArray[Any], path: Path, **known: Any) -> Image:
    """Image of floats, uint8 or uint16, (H, W) or (H, W, C)."""
    stacked = numbers if numbers.ndim == 3 else numbers[..., None]
    stacked = stacked.astype(stacked.dtype.newbyteorder("="), copy=False)
    if stacked.dtype.kind == "f" and stacked.shape[2] > 1 and stacked.dtype.itemsize > 4:
        # Numbers beyond the range of float32 become infinite, which is reported later.
        with np.errstate(over="ignore", invalid="ignore"):
            stacked = stacked.astype(np.float32)
    return Image(stacked, path, **known)


def _from_exr(path: Path, channel: str | None, prefer: Callable[[str], bool] | None, limit: int) -> Image:
    channels, headers = read_layers(path, limit)
    names = choose_channels(list(channels), path, channel, prefer)
    check_floats({name: channels[name] for name in names}, path)
    image = _decoded(np.stack([channels[n] for n in names], axis=-1), path, tags=exr_tags(headers[names[0]]))
    excess, compression = lossy_excess(headers[names[0]])
    several = tuple(names) if len(channels) > len(names) else ()
    return replace(image, channels=several, excess=excess, compression=compression)


def _pick(image: Image, channel: str) -> Image:
    """One channel of an image by its letter."""
    names = {1: "Y", 2: "YA", 3: "RGB", 4: "RGBA"}[image.stored.shape[2]]
    if channel.upper() not in tuple(names):
        raise InputError(f"has no channel '{channel}'", where=image.path, hint=f"it has {', '.join(names)}")
    index = names.index(channel.upper())
    return replace(image, stored=image.stored[..., index : index + 1], channels=(names[index],))


def _from_npy(path: Path, max_pixels: int) -> Image:
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception:  # a damaged header may make the parser raise anything, its bytes included
        what = "cannot be read as an npy array: it is damaged, cut short, or holds Python objects"
        raise InputError(what, where=path) from None
    if array.ndim not in (2, 3) or (array.ndim == 3 and not 1 <= array.shape[2] <= 4):
        raise InputError(f"has the shape {array.shape}; (H, W) or (H, W, 1..4) is expected", where=path)
    check_size(path, array.shape[0], array.shape[1], max_pixels)
    if array.dtype.kind == "f" or array.dtype in (np.uint8, np.uint16):
        return _decoded(np.array(array), path)
    raise InputError(f"contains {array.dtype} numbers; uint8, uint16 or floats are expected", where=path)


def _from_pillow(path: Path, kind: str, max_pixels: int) -> Image:
    from PIL import BmpImagePlugin, JpegImagePlugin, PngImagePlugin, TgaImagePlugin, TiffImagePlugin

    codes, tags = None, None
    if kind == "TIFF":
        codes, tags = read_tiff(path, max_pixels)
    elif kind == "JPEG" and (scans := path.read_bytes().count(b"\xff\xda")) > _MOST_SCANS:
        raise InputError(
            f"has {scans} scans; at most {_MOST_SCANS} are read", where=path, hint="save it anew"
        )
    # Pillow's own limit of the size is checked where it guesses formats, not here.
    reader: Any = {
        "PNG": PngImagePlugin.PngImageFile,
        "JPEG": JpegImagePlugin.JpegImageFile,
        "TIFF": TiffImagePlugin.TiffImageFile,
        "TGA": TgaImagePlugin.TgaImageFile,
        "BMP": BmpImagePlugin.BmpImageFile,
    }[kind]
    try:
        with python_warnings.catch_warnings(), silenced() if kind == "TIFF" else contextlib.nullcontext():
            python_warnings.simplefilter("ignore")
            if tags is None or codes is None:
                with reader(path) as picture:
                    deep = _DEEP_PNG.get(picture.tile[0][3]) if kind == "PNG" else None
                    size = 2 * deep if deep else len(picture.getbands())
                    check_size(path, picture.height, picture.width, max_pixels, size)
                    if kind == "BMP" and picture.info.get("compression") in _RUN_LENGTHS:
                        raise InputError("has run lengths", where=path, hint="save it without compression")
                    if deep:
                        codes = _deep_png(path, picture.height, picture.width, deep)
                    elif codes is None:
                        codes = _codes(picture, path)
                    png = path if kind == "PNG" else None
                    tags = tags or pillow_tags(picture.info, picture.getexif(), png)
    except InputError:
        raise
    except Exception as error:  # a damaged file may make the decoder raise anything
        fault = "its header is damaged" if isinstance(error, SyntaxError) else reason(error)
        raise InputError(f"cannot be read as a {kind} image ({fault})", where=path) from None
    return _decoded(codes, path, tags=tags)


def _deep_png(path: Path, rows: int, columns: int, channels: int) -> NDArray[np.uint16]:
    """Codes (H, W, C) of a 16-bit color PNG."""
    import imagecodecs

    with silenced():
        codes = imagecodecs.png_decode(path.read_bytes())
    # The decoder turns a transparent color into an alpha channel, which is left out.
    return np.ascontiguousarray(codes.reshape(rows, columns, -1)[..., :channels])


def _codes(picture: Any, path: Path) -> NDArray[Any]:
    """Decoded pixels (H, W) or (H, W, C) of a picture that Pillow has opened."""
    mode = picture.mode
    plain = {"P": "RGBA" if "transparency" in picture.info else "RGB", "PA": "RGBA", "1": "L", "YCbCr": "RGB"}
    deep = mode.startswith("I;16") or (mode == "I" and picture.format == "PNG")
    if not deep and mode not in (*plain, "L", "LA", "RGB", "RGBA", "F"):
        raise InputError(
            f"has the unsupported pixel mode '{mode}'", where=path, hint="save it as gray or RGB"
        )
    numbers = np.asarray(picture.convert(plain[mode]) if mode in plain else picture)
    return numbers.astype(np.uint16) if deep else numbers


def gray(image: Image) -> tuple[NDArray[np.float64], list[str]]:
    """One number per pixel (H, W) of an image, and warnings.

    RGB images become their Rec.709 luminance, with a warning where channels differ by more than the rounding
    of JPG (two 8-bit codes). Alpha is dropped, with a warning where it is not 1.
    """
    pixels, warnings = image.stored, []
    if pixels.shape[2] in (2, 4) and np.any(pixels[..., -1] != image.white):
        warnings.append(f"{image.path}: its alpha channel is not used")
    rgb = pixels[..., : 3 if pixels.shape[2] > 2 else 1]
    # Large maps: no more copies than needed.
    values = rgb[..., 0].astype(np.float64)
    spread = 0.0 if rgb.shape[2] == 1 else float(np.max(rgb.max(axis=-1) - rgb.min(axis=-1)))
    if spread == 0.0:
        values /= image.white
        return values, warnings
    tolerance = _GRAY_CODES if image.bits == 8 else 1e-4 * float(np.abs(rgb).max())
    if spread > tolerance:
        warnings.append(
            f"{image.path}: is colored where one number per pixel is expected; its luminance is used"
        )
    values *= LUMINANCE[0]
    for weight, channel in zip(LUMINANCE[1:], (rgb[..., 1], rgb[..., 2]), strict=True):
        values += weight * channel.astype(np.float64)
    values /= image.white
    return values, warnings


def linear_rgb(image: Image, space: ColorSpace | None = None) -> NDArray[np.float32]:
    """Linear Rec.709 colors (H, W, 3) of an image; gray is repeated, alpha dropped. Without a color space of
    the numbers it is that of the file, else sRGB for integers and linear for floats. Not clamped: colors of
    wider primaries may leave [0, 1]."""
    declared = image.tags.declared if space is None else None
    space = space or image.space
    curves = declared.curves if declared is not None else (srgb,) if space == "srgb" else ()
    rgb = image.stored[..., :3] if image.stored.shape[2] > 2 else image.stored[..., :1]
    out = np.empty((*image.shape, 3), np.float32)
    # A curve of codes is a table.
    codes = None if image.bits is None else np.arange(image.white + 1) / image.white
    for k in range(3):
        channel = rgb[..., k % rgb.shape[2]]
        curve = curves[k % len(curves)] if curves else None
        if codes is not None:
            table = codes if curve is None else curve(codes)
            out[..., k] = table.astype(np.float32)[channel]
        else:
            out[..., k] = channel if curve is None else curve(channel.astype(np.float64))
    if declared is not None and declared.matrix is not None:
        matrix = declared.matrix.T.astype(np.float32)
        for row in out:
            row[...] = row @ matrix
    return out

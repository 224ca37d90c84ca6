"""Images as arrays: EXR, PNG, JPG, TIFF, TGA, BMP and npy, decoded without loss.

Integer images become ``code / largest code``; float images keep their numbers. The material decides which
maps are sRGB; no color space is applied here.
"""

from __future__ import annotations

import contextlib
import io
import logging
import tempfile
import warnings as python_warnings
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError, reason
from mbtf_core.images.exr import check_floats, choose_channels, read_channels, silenced
from mbtf_core.paths import refuse_special, suggest_path

# Largest image that is allocated (11 585² pixels), whatever size a header claims.
MAX_PIXELS = 2**27

# Upper bound of the compression of these formats (PNG reaches 1032 : 1, with 8 pixels in a byte).
_PIXELS_PER_BYTE = 1 << 14

# Gray images stored as color JPG come back with channels that differ by rounding.
_GRAY_CODES = 2.0 / 255.0

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
# Photometric interpretations of TIFF that are read as stored.
_GRAY, _RGB = 1, 2
_SHORT = "cannot be read as a TIFF image (file ends early)"
# Compressions of BMP, whose decoder is slow and fills whatever a small file leaves out.
_RUN_LENGTHS = (1, 2)
# Channels of PNG color types of more than one channel.
_PNG_COLORS = {2: 3, 4: 2, 6: 4}
SUFFIXES = tuple(_KINDS)


ColorSpace = Literal["srgb", "linear"]

# Stored gammas of the known spaces (sRGB: 1/2.2), and the tolerance of their comparison.
_GAMMAS: dict[ColorSpace, float] = {"srgb": 0.45455, "linear": 1.0}
_SLACK = 0.005


@dataclass(frozen=True)
class Tags:
    """Metadata of an image file.

    Attributes
    ----------
    space : declared color space, if supported
    foreign : unsupported declaration, such as ``color profile 'Display P3'``
    orientation : of EXIF; 1 is upright
    """

    space: ColorSpace | None = None
    foreign: str | None = None
    orientation: int = 1


NO_TAGS = Tags()


@dataclass(frozen=True)
class Image:
    """A decoded image.

    Attributes
    ----------
    pixels : (H, W, C) float64 (C = 1) or float32 array
        Row 0 is the top; C = 1 gray, 2 gray and alpha, 3 RGB, 4 RGBA; all finite.
    bits : 8 or 16 for integer files, whose pixels are code / largest code; None for floats
    path : the file
    tags : color space and orientation that the file declares; not applied here
    channels : names of the selected channels; empty where the file has no others
    """

    pixels: NDArray[np.floating[Any]]
    bits: int | None
    path: Path
    tags: Tags = NO_TAGS
    channels: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.pixels.shape[0], self.pixels.shape[1]


def is_image(path: Path) -> bool:
    """Is the suffix that of an image format that can be read?"""
    return path.suffix.lower() in _KINDS


def read_image(
    path: str | Path, channel: str | None = None, prefer: Callable[[str], bool] | None = None
) -> Image:
    """Decode an image file.

    Parameters
    ----------
    path : EXR, PNG, JPG, TIFF, TGA, BMP or npy file
    channel : a channel or layer of an EXR file; R, G, B, A or Y of other formats. None: see
        :func:`~mbtf_core.images.exr.choose_channels`
    prefer : predicate on the layer names of an EXR file, for files of several layers

    Raises
    ------
    InputError : the file is missing, empty, damaged, truncated, unsupported, larger than ``MAX_PIXELS``, or
        not of the format of its suffix; the channel is missing; or pixels are NaN or infinite
    """
    path = Path(path)
    kind = _kind(path)
    if kind == "EXR":
        image = _from_exr(path, channel, prefer)
    else:
        image = _from_npy(path) if kind == "NPY" else _from_pillow(path, kind)
        image = image if channel is None else _pick(image, channel)
    bad = ~np.isfinite(image.pixels).all(axis=-1)
    if bad.any():
        raise InputError(f"{count_and_first(bad)} NaN or infinite", where=path)
    return image


def decode_image(content: bytes, kinds: Container[str], where: Path) -> Image:
    """Decode an image that is not in a file of its own.

    Parameters
    ----------
    content : the bytes of an image file
    kinds : accepted formats, such as ``PNG`` and ``JPEG``
    where : where it comes from, for messages

    Raises
    ------
    InputError : it has another format, or as :func:`read_image`
    """
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
    refuse_special(path)
    try:
        with path.open("rb") as stream:
            start = stream.read(8)
    except FileNotFoundError:
        raise InputError("no such file", where=path, hint=suggest_path(path, is_image)) from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None
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


def _check_size(rows: int, columns: int, path: Path) -> None:
    if rows * columns > MAX_PIXELS:
        raise InputError(f"claims {columns} x {rows} pixels; at most {MAX_PIXELS:,} are read", where=path)
    if rows * columns <= 0:
        raise InputError("contains no pixels", where=path)
    size = path.stat().st_size
    if rows * columns > _PIXELS_PER_BYTE * size:
        raise InputError(f"is cut short: {size} bytes cannot hold {columns} x {rows} pixels", where=path)


def _decoded(numbers: NDArray[Any], path: Path) -> Image:
    """Image of floats, uint8 or uint16, (H, W) or (H, W, C)."""
    stacked = numbers if numbers.ndim == 3 else numbers[..., None]
    dtype = np.float64 if stacked.shape[2] == 1 else np.float32
    if stacked.dtype.kind != "f":
        bits = 8 * stacked.dtype.itemsize
        return Image(np.divide(stacked, 2**bits - 1, dtype=dtype), bits, path)
    # Numbers beyond the range of float32 become infinite, which is reported later.
    with np.errstate(over="ignore", invalid="ignore"):
        return Image(stacked.astype(dtype), None, path)


def _from_exr(path: Path, channel: str | None, prefer: Callable[[str], bool] | None) -> Image:
    channels = read_channels(path, MAX_PIXELS)
    names = choose_channels(list(channels), path, channel, prefer)
    check_floats({name: channels[name] for name in names}, path)
    image = _decoded(np.stack([channels[n] for n in names], axis=-1), path)
    return replace(image, channels=tuple(names) if len(channels) > len(names) else ())


def _pick(image: Image, channel: str) -> Image:
    """One channel of an image by its letter."""
    names = {1: "Y", 2: "YA", 3: "RGB", 4: "RGBA"}[image.pixels.shape[2]]
    if channel.upper() not in tuple(names):
        raise InputError(f"has no channel '{channel}'", where=image.path, hint=f"it has {', '.join(names)}")
    index = names.index(channel.upper())
    numbers = _exact(image.pixels[..., index], image.bits)
    return replace(image, pixels=numbers[..., None], channels=(names[index],))


def _exact(numbers: NDArray[np.floating[Any]], bits: int | None) -> NDArray[np.float64]:
    """Exact fractions code / largest code from their single-precision values."""
    if bits is None:
        return numbers.astype(np.float64)
    largest = 2**bits - 1
    return np.rint(numbers.astype(np.float64) * largest) / largest


def _from_npy(path: Path) -> Image:
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception:  # a damaged header may make the parser raise anything, its bytes included
        what = "cannot be read as an npy array: it is damaged, cut short, or holds Python objects"
        raise InputError(what, where=path) from None
    if array.ndim not in (2, 3) or (array.ndim == 3 and not 1 <= array.shape[2] <= 4):
        raise InputError(f"has the shape {array.shape}; (H, W) or (H, W, 1..4) is expected", where=path)
    _check_size(array.shape[0], array.shape[1], path)
    if array.dtype.kind == "f" or array.dtype in (np.uint8, np.uint16):
        return _decoded(array, path)
    raise InputError(f"contains {array.dtype} numbers; uint8, uint16 or floats are expected", where=path)


def _from_pillow(path: Path, kind: str) -> Image:
    import PIL
    from PIL import Image as Pillow

    codes: NDArray[Any] | None = None
    if kind in ("PNG", "TIFF"):
        codes = _deep_png(path) if kind == "PNG" else _read_tiff(path)
    if codes is not None:
        return replace(_decoded(codes, path), tags=_tags(path, kind))
    try:
        with python_warnings.catch_warnings(), silenced() if kind == "TIFF" else contextlib.nullcontext():
            python_warnings.simplefilter("ignore")
            with Pillow.open(path, formats=[kind]) as picture:
                _check_size(picture.height, picture.width, path)
                if kind == "BMP" and picture.info.get("compression") in _RUN_LENGTHS:
                    raise InputError("has run lengths", where=path, hint="save it without compression")
                picture.load()
                return replace(_from_picture(picture, path), tags=_tags_of(picture.info, picture.getexif()))
    except Pillow.DecompressionBombError:
        raise InputError(f"claims more than {MAX_PIXELS:,} pixels", where=path) from None
    except InputError:
        raise
    except Exception as error:  # a damaged file may make the decoder raise anything
        fault = "its header is damaged" if isinstance(error, PIL.UnidentifiedImageError) else reason(error)
        raise InputError(f"cannot be read as a {kind} image ({fault})", where=path) from None


def _deep_png(path: Path) -> NDArray[np.uint16] | None:
    """Codes (H, W, C) of a 16-bit color PNG, of which Pillow keeps the upper eight bits; None of others."""
    with path.open("rb") as stream:
        head = stream.read(33)
    if len(head) < 33 or head[12:16] != b"IHDR":
        return None
    columns, rows = int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    _check_size(rows, columns, path)
    channels = _PNG_COLORS.get(head[25])
    if head[24] != 16 or channels is None:
        return None
    import imagecodecs

    try:
        with silenced():
            codes = imagecodecs.png_decode(path.read_bytes())
    except Exception as error:  # a damaged file may make the decoder raise anything
        raise InputError(f"cannot be read as a PNG image ({reason(error)})", where=path) from None
    # The decoder turns a transparent color into an alpha channel, which is left out.
    return np.ascontiguousarray(codes.reshape(rows, columns, -1)[..., :channels])


def _read_tiff(path: Path) -> NDArray[Any] | None:
    """The first image of a TIFF file, (H, W, C), C = 1..4, as stored: uint8, uint16 or floats, however
    compressed. None for kinds that Pillow reads: palettes, single bits, inverted gray, YCbCr."""
    import tifffile

    # The library logs faults that its exception already reports.
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    try:
        with tifffile.TiffFile(path) as file:
            page: Any = file.pages[0]
            rows, columns = int(page.imagelength), int(page.imagewidth)
            _check_size(rows, columns, path)
            channels = int(page.samplesperpixel)
            if page.photometric not in (_GRAY, _RGB) or page.dtype is None:
                return None
            if page.bitspersample != 8 * page.dtype.itemsize:
                return None if page.bitspersample < 8 else _refuse(f"{page.bitspersample}-bit", path)
            if page.dtype.kind == "f" or page.dtype in (np.uint8, np.uint16):
                if not 1 <= channels <= 4 or page.imagedepth != 1:
                    raise InputError(f"has {channels} channels; 1 to 4 are expected", where=path)
                # Missing strips or tiles of a truncated file would be read as zeros.
                ends = (o + n for o, n in zip(page.dataoffsets, page.databytecounts, strict=True))
                if not page.is_contiguous and any(end > path.stat().st_size for end in ends):
                    raise InputError(_SHORT, where=path)
                array = page.asarray(maxworkers=1)
            elif page.dtype.kind in "ui" and page.dtype.itemsize > 1:
                _refuse(page.dtype.name, path)
            else:
                return None
    except InputError:
        raise
    except Exception as error:  # a damaged file may make the decoder raise anything
        raise InputError(f"cannot be read as a TIFF image ({reason(error)})", where=path) from None
    if page.planarconfig == 2 and channels > 1:
        array = np.moveaxis(array.reshape(channels, rows, columns), 0, -1)
    if array.size != rows * columns * channels:
        raise InputError(_SHORT, where=path)
    return array.reshape(rows, columns, channels)


def _refuse(kind: str, path: Path) -> NoReturn:
    raise InputError(f"contains {kind} numbers", where=path, hint="save it as 8 or 16 bits or as floats")


def _tags(path: Path, kind: str) -> Tags:
    """Tags of a file whose pixels another reader has decoded; none where they cannot be read."""
    from PIL import Image as Pillow

    try:
        with python_warnings.catch_warnings(), silenced():
            python_warnings.simplefilter("ignore")
            with Pillow.open(path, formats=[kind]) as picture:
                return _tags_of(picture.info, picture.getexif())
    except Exception:  # what the library does not know may make it raise anything
        return NO_TAGS


def _from_picture(picture: Any, path: Path) -> Image:
    mode = picture.mode
    plain = {"P": "RGBA" if "transparency" in picture.info else "RGB", "PA": "RGBA", "1": "L", "YCbCr": "RGB"}
    deep = mode.startswith("I;16") or (mode == "I" and picture.format == "PNG")
    if mode in plain:
        picture = picture.convert(plain[mode])
    if deep or picture.mode in ("L", "LA", "RGB", "RGBA", "F"):
        numbers = np.asarray(picture)
        return _decoded(numbers.astype(np.uint16) if deep else numbers, path)
    raise InputError(f"has the unsupported pixel mode '{mode}'", where=path, hint="save it as gray or RGB")


def gray(image: Image) -> tuple[NDArray[np.float64], list[str]]:
    """Reduce an image to one number per pixel.

    RGB images become their Rec.709 luminance, with a warning where channels differ by more than the rounding
    of JPG (two 8-bit codes). Alpha is dropped, with a warning where it is not 1.

    Parameters
    ----------
    image : Image

    Returns
    -------
    values : (H, W) float64 array
    warnings : list of str
    """
    pixels, warnings = image.pixels, []
    if pixels.shape[2] in (2, 4) and np.any(pixels[..., -1] != 1.0):
        warnings.append(f"{image.path}: its alpha channel is not used")
    rgb = pixels[..., : 3 if pixels.shape[2] > 2 else 1]
    spread = float(np.max(rgb.max(axis=-1) - rgb.min(axis=-1)))
    if spread == 0.0:
        return _exact(rgb[..., 0], image.bits), warnings
    tolerance = _GRAY_CODES if image.bits == 8 else 1e-4 * float(np.abs(rgb).max())
    if spread > tolerance:
        warnings.append(
            f"{image.path}: is colored where one number per pixel is expected; its luminance is used"
        )
    return rgb.astype(np.float64) @ np.asarray(LUMINANCE), warnings


def _tags_of(info: Mapping[Any, Any], exif: Mapping[int, Any]) -> Tags:
    """Tags from the metadata that Pillow read.

    The profile takes precedence over the ``sRGB`` chunk, and that over ``gAMA`` (PNG specification, third
    edition, 4.3). A gamma of 1 means linear, 1/2.2 sRGB; a profile whose description names sRGB means sRGB.
    Other profiles and gammas are reported, not applied.
    """
    from PIL import ExifTags

    orientation = exif.get(ExifTags.Base.Orientation, 1)
    turned = orientation if orientation in range(1, 9) else 1
    space: ColorSpace | None = None
    foreign = None
    gamma = info.get("gamma")
    if info.get("icc_profile"):
        name = _profile_name(info["icc_profile"])
        space, foreign = ("srgb", None) if "srgb" in name.lower() else (None, f"color profile '{name}'")
    elif "srgb" in info:
        space = "srgb"
    elif isinstance(gamma, float) and gamma > 0:
        space = next((s for s, g in _GAMMAS.items() if abs(gamma - g) < _SLACK), None)
        foreign = None if space else f"gamma of {gamma:g}"
    return Tags(space, foreign, turned)


def _profile_name(profile: bytes) -> str:
    """Description of an ICC profile, one line."""
    from PIL import ImageCms

    try:
        text = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile)))
    except Exception:  # a damaged profile may make the library raise anything
        return "unreadable"
    printable = "".join(c for c in " ".join(text.split()) if c.isprintable())
    return printable[:60] or "without a name"

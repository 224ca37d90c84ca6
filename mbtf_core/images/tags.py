"""Metadata of image files: color space, orientation, and what terrains declare."""

from __future__ import annotations

import contextlib
import io
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.images.color_spaces import (
    ADOBE_RGB,
    REC709,
    ColorSpace,
    Curve,
    DeclaredSpace,
    from_chromaticities,
    from_cicp,
    from_icc,
    power,
    srgb,
)

# Stored gammas of the known spaces (sRGB: 1/2.2), and the tolerance of their comparison.
_GAMMAS: dict[ColorSpace, float] = {"srgb": 0.45455, "linear": 1.0}
_SLACK = 0.005
# Tags of EXIF, TIFF and GeoTIFF.
_INTEROPERABILITY = 0xA005
_ORIENTATION, _WHITE, _PRIMARIES, _PROFILE = 274, 318, 319, 34675
_PIXEL_SCALE, _TIE_POINT, _TRANSFORMATION, _KEYS, _NODATA = 33550, 33922, 34264, 34735, 42113
# Key of the model type, its value for degrees, and meters of a degree of latitude.
_MODEL_TYPE, _GEOGRAPHIC, _DEGREE = 1024, 2, 111_320.0


@dataclass(frozen=True)
class Tags:
    """Metadata of an image file.

    Attributes
    ----------
    space : declared color space, if it is sRGB or linear Rec.709
    declared : another declared color space, which can be converted
    foreign : declaration that is not supported, such as ``color profile 'CMYK'``, or the profile that is
        `space` in spite of its name
    orientation : of EXIF; 1 is upright
    nodata : number that stands for missing data
    pixel_size : distance of neighboring columns, in meters or the file's own unit
    unused : what else the file holds, as warnings
    """

    space: ColorSpace | None = None
    declared: DeclaredSpace | None = None
    foreign: str | None = None
    orientation: int = 1
    nodata: float | None = None
    pixel_size: float | None = None
    unused: tuple[str, ...] = ()


NO_TAGS = Tags()
# Color space of a file: (space, declared, foreign) as in Tags.
_Color = tuple[ColorSpace | None, DeclaredSpace | None, str | None]


def pillow_tags(info: Mapping[Any, Any], exif: Any, path: Path | None = None) -> Tags:
    """Tags from the metadata that Pillow read, and from a PNG file, whose ``cICP`` it does not read.

    ``cICP`` takes precedence over the profile, that over the ``sRGB`` chunk, and that over ``gAMA`` and
    ``cHRM`` (PNG specification, third edition, 4.3). Cameras declare Adobe RGB in EXIF (DCF 2.0).
    """
    coded = None if path is None else _cicp_chunk(path)
    gamma, primaries = info.get("gamma"), info.get("chromaticity")
    color: _Color = (None, None, None)
    if coded is not None:
        try:
            color = _color(from_cicp(coded))
        except (ValueError, struct.error):
            color = (None, None, f"cICP chunk ({' '.join(map(str, coded[:4]))})")
    elif info.get("icc_profile"):
        color = _profile(info["icc_profile"])
    elif "srgb" in info:
        color = ("srgb", None, None)
    elif primaries is not None or isinstance(gamma, float):
        # PNG stores white first.
        red_first = (*primaries[2:], *primaries[:2]) if primaries is not None else REC709
        color = _gamma(gamma if isinstance(gamma, float) else None, red_first)
    elif _is_adobe_rgb(exif):
        color = _color(from_chromaticities(ADOBE_RGB, *[power(2.19921875)] * 3))
    return Tags(*color, _upright(exif.get(_ORIENTATION, 1)))


def tiff_tags(tags: Any) -> Tags:
    """Tags of a page of tifffile: profile, primaries, orientation, and those of GDAL and GeoTIFF."""
    found = {code: tags.valueof(code) for code in (_ORIENTATION, _WHITE, _PRIMARIES, _PROFILE)}
    color: _Color = (None, None, None)
    if isinstance(found[_PROFILE], bytes):
        color = _profile(found[_PROFILE])
    elif found[_PRIMARIES] is not None:
        white = found[_WHITE]
        color = _gamma(None, (*_ratios(found[_PRIMARIES]), *(_ratios(white) if white else REC709[6:])))
    nodata = None
    with contextlib.suppress(ValueError):
        nodata = float(str(tags.valueof(_NODATA)).strip(" \0"))
    return Tags(*color, _upright(found[_ORIENTATION]), nodata, _pixel_size(tags))


def exr_tags(header: Mapping[str, Any]) -> Tags:
    """Tags of a part of an EXR file: its chromaticities."""
    primaries = header.get("chromaticities")
    if primaries is None:
        return NO_TAGS
    try:
        declared = from_chromaticities([float(n) for n in primaries])
    except (ValueError, TypeError):
        return Tags(foreign="chromaticities attribute (no color space)")
    # Numbers are linear by the format; files of Rec.709 need no mention.
    return NO_TAGS if declared.known else Tags(declared=declared)


def _is_adobe_rgb(exif: Any) -> bool:
    try:
        return bool(exif.get_ifd(_INTEROPERABILITY).get(1) == "R03")
    except Exception:  # damaged metadata may make the library raise anything
        return False


def _color(declared: DeclaredSpace) -> _Color:
    known = declared.known
    return (known, None, None) if known is not None else (None, declared, None)


def _gamma(gamma: float | None, primaries: Sequence[float]) -> _Color:
    """The color space of a ``gAMA`` and a ``cHRM`` chunk; the curve of sRGB where no gamma is given."""
    try:
        plain = from_chromaticities(primaries).matrix is None
        if gamma is None or not 0.01 < gamma < 100:
            return ("srgb", None, None) if plain else _color(from_chromaticities(primaries, *[srgb] * 3))
        if plain:
            named = next((s for s, g in _GAMMAS.items() if abs(gamma - g) < _SLACK), None)
            if named is not None:
                return named, None, None
        curve: Curve = power(1.0 / gamma)
        found = from_chromaticities(primaries, *[curve] * 3)
        name = f"gamma of {gamma:g}" if plain else f"{found.name}, gamma of {gamma:g}"
        return None, DeclaredSpace(name, found.curves, found.matrix), None
    except ValueError:
        return None, None, "chromaticities (no color space)"


def _profile(content: bytes) -> _Color:
    """The color space of an ICC profile; one that cannot be evaluated is sRGB if its name says so."""
    name = _profile_name(content)
    try:
        found = _color(from_icc(content, name))
        misnamed = found[0] == "srgb" and "srgb" not in name.lower()
        return (*found[:2], f"color profile '{name}'") if misnamed else found
    except ValueError:
        pass
    if "srgb" in name.lower() and "linear" not in name.lower():
        return "srgb", None, None
    return None, None, f"color profile '{name}'"


def _profile_name(profile: bytes) -> str:
    """Description of an ICC profile, one line."""
    from PIL import ImageCms

    try:
        text = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile)))
    except Exception:  # a damaged profile may make the library raise anything
        return "unreadable"
    printable = "".join(c for c in " ".join(text.split()) if c.isprintable())
    return printable[:60] or "without a name"


def _upright(orientation: Any) -> int:
    return orientation if orientation in range(1, 9) else 1


def _ratios(numbers: Sequence[int]) -> list[float]:
    """Numbers of numerators and denominators in turn."""
    return [n / d if d else math.nan for n, d in zip(numbers[::2], numbers[1::2], strict=False)]


def _pixel_size(tags: Any) -> float | None:
    """Distance of the columns of a GeoTIFF; of degrees, in meters at the latitude of its first tie point."""
    scale, matrix, keys = (tags.valueof(code) for code in (_PIXEL_SCALE, _TRANSFORMATION, _KEYS))
    tie = tags.valueof(_TIE_POINT)
    try:
        size = abs(scale[0]) if scale else math.hypot(matrix[0], matrix[4])
        entries = [tuple(keys[i : i + 4]) for i in range(4, len(keys or ()), 4)]
        if (_MODEL_TYPE, 0, 1, _GEOGRAPHIC) in entries:
            size *= _DEGREE * math.cos(math.radians(tie[4] if tie else matrix[7]))
    except (TypeError, IndexError, ValueError):
        return None
    return float(size) if 0 < size < math.inf else None


def _cicp_chunk(path: Path) -> bytes | None:
    """Content of the chunk ``cICP`` of a PNG file, at most 64 bytes of it."""
    with path.open("rb") as stream:
        stream.seek(8)
        while len(head := stream.read(8)) == 8:
            size, name = struct.unpack(">I4s", head)
            if name == b"cICP":
                return stream.read(min(size, 64))
            if name in (b"IDAT", b"IEND"):
                return None
            stream.seek(size + 4, io.SEEK_CUR)
    return None

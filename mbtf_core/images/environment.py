"""Pictures of the whole sphere: light from all around."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError, reason
from mbtf_core.images.color_spaces import from_chromaticities
from mbtf_core.images.limits import MAX_PIXELS, check_size
from mbtf_core.images.read import SUFFIXES, Image, linear_rgb, read_image
from mbtf_core.images.resample import resample
from mbtf_core.images.tags import Tags
from mbtf_core.paths import suggest_path

_log = logging.getLogger(__name__)

_RADIANCE = ".hdr"
# Header of a Radiance picture whose first row is the top one, and its line of primaries.
_HEAD = re.compile(rb"#\?[^\0]*?\n\n-Y +(?P<rows>\d{1,9}) +\+X +(?P<columns>\d{1,9})\n")
_PRIMARIES = re.compile(rb"\nPRIMARIES= *([-+.eE\d ]+)\n")


def read_environment(path: Path, most_rows: int) -> NDArray[np.float32]:
    """A picture of the whole sphere, seen from inside: rows by latitude, the top one at z.

    Column i of n is at azimuth 90° - 360° (i + ½) / n, as in an ``envmap`` of Mitsuba that is turned by 90°
    about x, which puts z up.

    Parameters
    ----------
    path : EXR, HDR, PNG, JPG, TIFF or npy file; integers are sRGB, unless the file declares another space
    most_rows : larger pictures are averaged down to so many rows

    Returns
    -------
    (rows, columns, 3) float32 array
        Linear RGB, at least 0.

    Raises
    ------
    InputError : the file cannot be read
    """
    suffix = path.suffix.lower()
    if path.is_file() and suffix not in (_RADIANCE, *SUFFIXES):
        raise InputError(
            f"'{path.suffix}' is not an image format that is read",
            where=path,
            hint=f"use one of {', '.join((_RADIANCE, *SUFFIXES))}",
        )
    pixels = _radiance(path) if suffix == _RADIANCE else _picture(path)
    rows = min(most_rows, pixels.shape[0])
    columns = min(max(1, round(rows * pixels.shape[1] / pixels.shape[0])), pixels.shape[1])
    small = np.asarray(resample(pixels, rows, columns), np.float32)
    return np.maximum(small, np.float32(0.0))


def _picture(path: Path) -> NDArray[np.float32]:
    image = read_image(path)
    if image.tags.foreign is not None and image.tags.space is None:
        _log.warning("%s: its %s is not applied; convert it to sRGB", path, image.tags.foreign)
    return linear_rgb(image)


def _radiance(path: Path) -> NDArray[np.float32]:
    """A Radiance picture (RGBE), in linear Rec.709."""
    import imagecodecs

    if not path.is_file():
        raise InputError("no such file", where=path, hint=suggest_path(path))
    content = path.read_bytes()
    head = _HEAD.match(content)
    if head is None:
        raise InputError(
            "cannot be read as a Radiance picture (its header is damaged, or it is turned)", where=path
        )
    check_size(path, int(head["rows"]), int(head["columns"]), MAX_PIXELS, 12)
    if b"FORMAT=32-bit_rle_xyze" in head[0]:
        raise InputError("has XYZ colors (XYZE)", where=path, hint="save it as RGBE")
    try:
        pixels = np.asarray(imagecodecs.rgbe_decode(content), np.float32)
        primaries = _PRIMARIES.search(head[0])
        space = from_chromaticities([float(n) for n in primaries[1].split()]) if primaries else None
    except Exception as error:  # whatever the decoder raises
        raise InputError(f"cannot be read as a Radiance picture ({reason(error)})", where=path) from None
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not np.isfinite(pixels).all():
        raise InputError("is not a picture of three colors", where=path)
    return linear_rgb(Image(pixels, path, Tags(declared=space)))

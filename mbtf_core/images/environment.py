"""Pictures of the whole sphere: light from all around, also as Radiance pictures (``.hdr``), whose pixels
share an exponent (RGBE)."""

from __future__ import annotations

import logging
import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError, reason
from mbtf_core.images.color_spaces import from_chromaticities
from mbtf_core.images.limits import MAX_PIXELS
from mbtf_core.images.read import Image, linear_rgb, read_image
from mbtf_core.images.resample import resample
from mbtf_core.images.tags import Tags
from mbtf_core.paths import opened

_log = logging.getLogger(__name__)

_RADIANCE = ".hdr"
# The line of the size of a picture whose first row is the top one. It ends the header; the largest header.
_SIZE = re.compile(rb"\n-Y +(\d{1,9}) +\+X +(\d{1,9})\n")
_MOST_HEADER = 1 << 16
# Factor that the stored values have been multiplied by; several lines multiply.
_EXPOSURE = re.compile(rb"^EXPOSURE *= *([^\n]*)$", re.MULTILINE)
_PRIMARIES = re.compile(rb"^PRIMARIES *= *([-+.eE\d ]+)$", re.MULTILINE)
# Upper bound of the compression: runs of 127 pixels take eight bytes.
_PIXELS_PER_BYTE = 16


def read_environment(path: Path, most_rows: int) -> NDArray[np.float32]:
    """A picture of the whole sphere, seen from inside: linear RGB (rows, columns, 3), at least 0, rows by
    latitude, the top one at z. Larger pictures are averaged down to so many rows. Errors are those of
    :func:`read_linear`.

    Column i of n is at azimuth 90° - 360° (i + ½) / n, as in an ``envmap`` of Mitsuba that is turned by 90°
    about x, which puts z up.
    """
    pixels = read_linear(path)
    rows = min(most_rows, pixels.shape[0])
    columns = min(max(1, round(rows * pixels.shape[1] / pixels.shape[0])), pixels.shape[1])
    small = np.asarray(resample(pixels, rows, columns), np.float32)
    return np.maximum(small, np.float32(0.0))


def read_linear(path: Path) -> NDArray[np.float32]:
    """Linear RGB (H, W, 3) of an EXR, HDR, PNG, JPG, TIFF or npy file; integers are sRGB, gray becomes RGB.
    An InputError where the file cannot be read, or a pixel is NaN or infinite."""
    image = read_radiance(path) if path.suffix.lower() == _RADIANCE else read_image(path)
    if image.tags.foreign is not None and image.tags.space is None:
        _log.warning("%s: its %s is not applied; convert it to sRGB", path, image.tags.foreign)
    return linear_rgb(image)


def read_radiance(path: Path) -> Image:
    """Linear RGB of the primaries that the header states, divided by its exposure; an InputError where the
    file is missing, damaged, too large, or stores XYZ."""
    import imagecodecs

    with opened(path) as stream:
        data = stream.read()
    try:
        size = _SIZE.search(data[:_MOST_HEADER])
        if size is None:
            raise InputError("is no Radiance picture, or it is turned", where=path, hint="save it again")
        rows, columns = (int(n) for n in size.groups())
        if rows * columns > min(MAX_PIXELS, _PIXELS_PER_BYTE * len(data)):
            raise InputError(f"claims {columns} x {rows} pixels in {len(data):,} bytes", where=path)
        header = data[: size.start() + 1]
        if b"32-bit_rle_xyze" in header:
            raise InputError("stores XYZ, not RGB", where=path, hint="convert it to RGB")
        exposure = math.prod(float(text) for text in _EXPOSURE.findall(header))
        if not 0.0 < exposure < math.inf:
            raise InputError(f"states an exposure of {exposure:g}", where=path, hint="a positive one is read")
        primaries = _PRIMARIES.search(header)
        space = from_chromaticities([float(n) for n in primaries[1].split()]) if primaries else None
        pixels = np.asarray(imagecodecs.rgbe_decode(data), np.float32) / np.float32(exposure)
    except InputError:
        raise
    except Exception as error:  # whatever the decoder raises
        raise InputError(f"cannot be read as a Radiance picture ({reason(error)})", where=path) from None
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not np.isfinite(pixels).all():
        raise InputError("is not a picture of three colors", where=path)
    return Image(pixels, path, Tags(declared=space))

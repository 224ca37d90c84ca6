"""Pictures of the whole sphere: light from all around."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.images.radiance import read_radiance
from mbtf_core.images.read import SUFFIXES, linear_rgb, read_image
from mbtf_core.images.resample import resample

_log = logging.getLogger(__name__)

_RADIANCE = ".hdr"


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
    pixels = read_linear(path)
    rows = min(most_rows, pixels.shape[0])
    columns = min(max(1, round(rows * pixels.shape[1] / pixels.shape[0])), pixels.shape[1])
    small = np.asarray(resample(pixels, rows, columns), np.float32)
    return np.maximum(small, np.float32(0.0))


def read_linear(path: Path) -> NDArray[np.float32]:
    """Linear RGB (H, W, 3) of an EXR, HDR, PNG, JPG, TIFF or npy file; integers are sRGB, gray becomes RGB.

    Raises
    ------
    InputError : the file cannot be read, or a pixel is NaN or infinite
    """
    suffix = path.suffix.lower()
    if path.is_file() and suffix not in (_RADIANCE, *SUFFIXES):
        raise InputError(
            f"'{path.suffix}' is not an image format that is read",
            where=path,
            hint=f"use one of {', '.join((_RADIANCE, *SUFFIXES))}",
        )
    image = read_radiance(path) if suffix == _RADIANCE else read_image(path)
    if image.tags.foreign is not None and image.tags.space is None:
        _log.warning("%s: its %s is not applied; convert it to sRGB", path, image.tags.foreign)
    return linear_rgb(image)

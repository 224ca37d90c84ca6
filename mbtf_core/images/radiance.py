"""Radiance pictures (``.hdr``), whose pixels share an exponent (RGBE)."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError, reason
from mbtf_core.images.read import MAX_PIXELS
from mbtf_core.paths import refuse_special, suggest_path

# The line of the size, which ends the header, and the largest header.
_SIZE = re.compile(rb"\n[-+][XY] +(\d{1,9}) +[-+][XY] +(\d{1,9})\n")
_MOST_HEADER = 1 << 16
# Factor that the stored values have been multiplied by; several lines multiply.
_EXPOSURE = re.compile(rb"^EXPOSURE *= *([^\n]*)$", re.MULTILINE)
# Upper bound of the compression: runs of 127 pixels take eight bytes.
_PIXELS_PER_BYTE = 16


def read_radiance(path: Path) -> NDArray[np.float64]:
    """Linear RGB (H, W, 3), divided by the exposure that the header states.

    Raises
    ------
    InputError : the file is missing, damaged, too large, or stores XYZ
    """
    import imagecodecs

    refuse_special(path)
    if not path.is_file():
        raise InputError("no such file", where=path, hint=suggest_path(path))
    try:
        data = path.read_bytes()
        size = _SIZE.search(data[:_MOST_HEADER])
        header = data[: size.start() + 1] if size else b""
        rows, columns = (int(n) for n in size.groups()) if size else (0, 0)
        if rows * columns > min(MAX_PIXELS, _PIXELS_PER_BYTE * len(data)):
            raise InputError(f"claims {columns} x {rows} pixels in {len(data):,} bytes", where=path)
        if b"32-bit_rle_xyze" in header:
            raise InputError("stores XYZ, not RGB", where=path, hint="convert it to RGB")
        exposure = math.prod(float(text) for text in _EXPOSURE.findall(header))
        if not 0.0 < exposure < math.inf:
            raise InputError(f"states an exposure of {exposure:g}", where=path, hint="a positive one is read")
        pixels = np.asarray(imagecodecs.rgbe_decode(data), np.float64) / exposure
    except InputError:
        raise
    except Exception as error:  # whatever the decoder raises
        raise InputError(f"cannot be read as a Radiance picture ({reason(error)})", where=path) from None
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not np.isfinite(pixels).all():
        raise InputError("is not a picture of three colors", where=path)
    return pixels

"""TIFF of 8 and 16 bits and of floats, gray or color, tiled or in strips, however compressed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError, reason

_GRAY, _RGB = 1, 2
_SHORT = "cannot be read as a TIFF image (file ends early)"


def read_tiff(path: Path, check_size: Callable[[int, int, Path], None]) -> NDArray[Any] | None:
    """The first image of a file, (H, W, C), C = 1..4, as stored: uint8, uint16 or floats.

    None for kinds that Pillow reads: palettes, single bits, inverted gray, YCbCr.

    Parameters
    ----------
    path : Path
    check_size : called with rows, columns and the path before any pixel is read; raises to refuse

    Raises
    ------
    InputError : the file is damaged, truncated or not supported
    """
    import tifffile

    # The library logs faults that its exception already reports.
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    try:
        with tifffile.TiffFile(path) as file:
            page: Any = file.pages[0]
            rows, columns = int(page.imagelength), int(page.imagewidth)
            check_size(rows, columns, path)
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

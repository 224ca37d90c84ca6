"""The first image of a TIFF file, with every number that it stores."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError, reason
from mbtf_core.images.limits import check_size
from mbtf_core.images.tags import Tags, tiff_tags

# Photometric interpretations that are read here.
_INVERTED, _GRAY, _RGB = 0, 1, 2
# Bits of the type of a page.
_REDUCED, _MASK = 1, 4
_SHORT = "cannot be read as a TIFF image (file ends early)"


def read_tiff(path: Path, max_pixels: int) -> tuple[NDArray[Any] | None, Tags]:
    """The first image (H, W, C) of a TIFF file, however compressed, and its tags.

    Its 1 to 4 channels are uint8, uint16 or floats as stored, float64 of other integers; None for kinds that
    Pillow reads: palettes, single bits, YCbCr. An InputError where the file is damaged, cut short, larger
    than `max_pixels`, or of an unsupported kind.
    """
    import tifffile

    # The library logs faults that its exception already reports.
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    try:
        with tifffile.TiffFile(path) as file:
            page: Any = file.pages[0]
            tags = replace(tiff_tags(page.tags), unused=_unused(file))
            return _numbers(page, path, max_pixels), tags
    except InputError:
        raise
    except Exception as error:  # a damaged file may make the decoder raise anything
        raise InputError(f"cannot be read as a TIFF image ({reason(error)})", where=path) from None


def _unused(file: Any) -> tuple[str, ...]:
    """What the second page is, unless the first one in a smaller size."""
    try:
        kind = int(file.pages[1].subfiletype)
    except Exception:  # there is none, or it is damaged, which does not concern the first one
        return ()
    if kind & _REDUCED:
        return ()
    return ("its mask is not used",) if kind & _MASK else ("only the first of its pages is used",)


def _numbers(page: Any, path: Path, max_pixels: int) -> NDArray[Any] | None:
    rows, columns = int(page.imagelength), int(page.imagewidth)
    channels, dtype = int(page.samplesperpixel), page.dtype
    check_size(path, rows, columns, max_pixels, channels * (1 if dtype is None else dtype.itemsize))
    if page.photometric not in (_INVERTED, _GRAY, _RGB) or dtype is None:
        return None
    if page.bitspersample != 8 * dtype.itemsize:
        return None if page.bitspersample < 8 else _refuse(f"{page.bitspersample}-bit", path)
    if dtype.kind not in "fiu":
        _refuse(dtype.name, path)
    if not 1 <= channels <= 4 or page.imagedepth != 1:
        raise InputError(f"has {channels} channels; 1 to 4 are expected", where=path)
    # Missing strips or tiles of a truncated file would be read as zeros.
    ends = (o + n for o, n in zip(page.dataoffsets, page.databytecounts, strict=True))
    if not page.is_contiguous and any(end > path.stat().st_size for end in ends):
        raise InputError(_SHORT, where=path)
    array = page.asarray(maxworkers=1)
    if page.planarconfig == 2 and channels > 1:
        array = np.moveaxis(array.reshape(channels, rows, columns), 0, -1)
    if array.size != rows * columns * channels:
        raise InputError(_SHORT, where=path)
    array = array.reshape(rows, columns, channels)
    if page.photometric == _INVERTED:
        if dtype.kind != "u":
            _refuse(f"inverted {dtype.name}", path)
        array[..., 0] = np.iinfo(dtype).max - array[..., 0]
    # Only codes of 8 and 16 bits are fractions of the largest one; others are numbers, such as meters.
    return array if dtype.kind == "f" or dtype in (np.uint8, np.uint16) else array.astype(np.float64)


def _refuse(kind: str, path: Path) -> NoReturn:
    raise InputError(f"contains {kind} numbers", where=path, hint="save it as 8 or 16 bits or as floats")

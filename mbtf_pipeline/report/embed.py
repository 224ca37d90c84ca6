"""Images and maps as ``data:`` URIs, and color bars."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import Palette, indices, palette, tick_labels, to_display

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
Pixels = NDArray[np.floating]
# A page's images by name, each a function of the reduction.
Gallery = dict[str, Callable[[int], str]]
# Side of the blocks of pixels that a page's images are averaged over, until it is small enough.
REDUCTIONS = (1, 2, 4, 8, 16)
_JPEG_QUALITY = 86


def color_bar(
    key: Palette, title: str, high: float, unit: str, factor: float = 1.0, *, clipped: bool = False
) -> dict[str, Any]:
    """A labeled color bar with five evenly spaced numbers up to `high`, which `factor` converts to `unit`;
    where values are `clipped`, its ends say so."""
    low = -high if key == "signed" else 0.0
    colors = palette(key)[np.linspace(0, 255, 17).round().astype(int)].tolist()
    ticks = tick_labels(low, high, factor)
    if clipped:
        ticks[-1] = f"≥ {ticks[-1]}"
        ticks[0] = f"≤ {ticks[0]}" if low else ticks[0]
    return {
        "key": key,
        "title": title,
        "gradient": f"linear-gradient(90deg, {', '.join('rgb({} {} {})'.format(*c) for c in colors)})",
        "ticks": ticks,
        "unit": unit,
    }


def shrink(values: Pixels, factor: int) -> Pixels:
    """Average `factor` × `factor` pixels of (rows, columns, ...); incomplete blocks are dropped."""
    if factor == 1:
        return values
    factor = min(factor, *values.shape[:2])
    rows, columns = (n // factor for n in values.shape[:2])
    cut = values[: rows * factor, : columns * factor]
    out: Pixels = cut.reshape(rows, factor, columns, factor, *values.shape[2:]).mean(axis=(1, 3))
    return out


def data_uri(display: U8, kind: Literal["png", "jpeg"] = "png", colors: Palette | None = None) -> str:
    """``data:`` URI of an 8-bit sRGB or gray image, or of indices into a palette."""
    from PIL import Image

    image = Image.fromarray(display)
    if colors is not None:
        image.putpalette(palette(colors).tobytes())
    stream = io.BytesIO()
    options = {"quality": _JPEG_QUALITY, "subsampling": 0} if kind == "jpeg" else {}
    image.save(stream, kind, optimize=True, **options)
    return f"data:image/{kind};base64,{base64.b64encode(stream.getvalue()).decode()}"


def linear_uri(picture: F32, exposure: float, reduction: int = 1) -> str:
    """``data:`` URI of a linear image (rows, columns, 3) in 1/sr at an exposure in EV, as PNG of averages of
    `reduction` × `reduction` pixels."""
    return data_uri(to_display(shrink(picture, reduction), exposure))


def map_uri(values: Pixels, name: Palette, reduction: int = 1) -> str:
    """``data:`` URI of a map (rows, columns) as PNG in the colors of a palette, likewise."""
    return data_uri(indices(shrink(values, reduction), name), colors=name)


def file_uri(path: Path, most: int | None = None) -> str:
    """``data:`` URI of an image file as JPEG, shrunk to so many pixels along a side at most.

    Raises
    ------
    OSError : missing or corrupt
    """
    from PIL import Image

    with Image.open(path) as image:
        small = image.convert("RGB")
    if most is not None:
        small.thumbnail((most, most))
    return data_uri(np.asarray(small), "jpeg")

"""Images and maps as ``data:`` URIs, and the palettes and scales of maps."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.color import to_display

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
Pixels = NDArray[np.floating]
Palette = Literal["local", "flip", "signed"]
# Color maps of magnitudes from 0 to 1. Both are perceptually uniform, with monotonic lightness.
_MAGNITUDES = {"local": "viridis", "flip": "magma"}
# sRGB colors of a signed difference from -1 (blue) over 0 (nearly black) to 1 (orange). Lightness encodes the
# magnitude. Blue and orange are distinguishable under every common color-vision deficiency.
_STOPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
_COLORS = ((199, 233, 255), (34, 136, 209), (13, 15, 20), (214, 98, 16), (255, 232, 189))
# A page's images by name, each a function of the reduction.
Gallery = dict[str, Callable[[int], str]]
# Side of the blocks of pixels that a page's images are averaged over, until it is small enough.
REDUCTIONS = (1, 2, 4, 8, 16)
_JPEG_QUALITY = 86


@cache
def palette(name: Palette) -> U8:
    """256 sRGB colors (256, 3) for magnitudes from 0 to 1, or for signed values from -1 to 1."""
    if name == "signed":
        t = np.linspace(-1.0, 1.0, 256)
        table = np.stack([np.interp(t, _STOPS, channel) for channel in zip(*_COLORS, strict=True)], axis=-1)
    else:
        from matplotlib import colormaps

        table = 255.0 * np.asarray(colormaps[_MAGNITUDES[name]](np.linspace(0.0, 1.0, 256)))[:, :3]
    return np.round(table).astype(np.uint8)


def indices(values: ArrayLike, name: Palette) -> U8:
    """Palette indices of values, clipped to the palette's range; NaN counts as 0."""
    x = np.nan_to_num(np.asarray(values, np.float64))
    if name == "signed":
        x = 0.5 * (x + 1.0)
    return np.round(255.0 * np.clip(x, 0.0, 1.0)).astype(np.uint8)


def round_scale(x: float) -> float:
    """Smallest of 1, 2, 5 times a power of ten that is not below x; 1 if x is not positive."""
    if not x > 0 or not math.isfinite(x):
        return 1.0
    power = 10.0 ** math.floor(math.log10(x))
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= x * (1 - 1e-9))


def common_scale(maps: Sequence[ArrayLike]) -> float:
    """Rounded end of the scale of several maps: the 99th percentile of all magnitudes."""
    return round_scale(float(np.percentile(np.concatenate([np.abs(np.ravel(m)) for m in maps]), 99)))


def color_bar(key: Palette, title: str, high: float, unit: str, factor: float = 1.0) -> dict[str, Any]:
    """A labeled color bar with five evenly spaced numbers up to `high`, which `factor` converts to `unit`."""
    low = -high if key == "signed" else 0.0
    colors = palette(key)[np.linspace(0, 255, 17).round().astype(int)].tolist()
    return {
        "key": key,
        "title": title,
        "gradient": f"linear-gradient(90deg, {', '.join('rgb({} {} {})'.format(*c) for c in colors)})",
        "ticks": [f"{factor * x:.3g}".replace("-", "−") for x in np.linspace(low, high, 5)],
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

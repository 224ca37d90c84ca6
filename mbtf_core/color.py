"""The transfer curve of sRGB (IEC 61966-2-1), and the display of linear values: one rule for all pictures.

An exposure is a number of stops (EV): a value v in 1/sr is displayed as sRGB of ``min(1, 2^EV v)``. Pictures
with the same exposure can be compared by eye, whichever command made them. The default keeps albedos: under
unit irradiance a Lambertian surface of albedo 0.5 is displayed as 0.5 of white. Palettes show maps of
magnitudes and of signed differences.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Shows 1/π in 1/sr as white, to hundredths of a stop.
ALBEDO_EXPOSURE = 1.65
# Percentile of a picture's mean channel, and the fraction of white as which the automatic exposure shows it.
_PERCENTILE, _SHOWN = 95.0, 0.8


def srgb_to_linear(encoded: ArrayLike) -> NDArray[np.floating[Any]]:
    """Linear light of sRGB-encoded numbers in [0, 1], any shape."""
    c = _floating(encoded)
    bent = ((np.maximum(c, 0.0) + c.dtype.type(0.055)) / c.dtype.type(1.055)) ** c.dtype.type(2.4)
    return np.where(c <= 0.04045, c / c.dtype.type(12.92), bent)


def linear_to_srgb(linear: ArrayLike) -> NDArray[np.floating[Any]]:
    """sRGB encoding of linear light in [0, 1], any shape; not clamped."""
    c = _floating(linear)
    root = np.maximum(c, 0.0) ** c.dtype.type(1.0 / 2.4)
    return np.where(c <= 0.0031308, c * c.dtype.type(12.92), c.dtype.type(1.055) * root - c.dtype.type(0.055))


def _floating(numbers: ArrayLike) -> NDArray[np.floating[Any]]:
    c = np.asarray(numbers)
    return c if c.dtype.kind == "f" else c.astype(np.float64)


def brightness(picture: ArrayLike, weights: ArrayLike | None = None) -> float:
    """The 95th percentile of the mean channel of linear values (..., 3), with weights (...)."""
    gray = np.asarray(picture, np.float64).mean(axis=-1)
    if weights is None:
        return float(np.percentile(gray, _PERCENTILE))
    w = np.asarray(weights, np.float64)
    return float(np.percentile(gray, _PERCENTILE, weights=w, method="inverted_cdf"))


def auto_exposure(bright: Iterable[float]) -> float:
    """Automatic exposure of pictures that are displayed alike.

    Parameters
    ----------
    bright : :func:`brightness` of each picture, in 1/sr

    Returns
    -------
    float
        Exposure in EV that shows the median as 0.8; 0 if it is black. Rounded to hundredths, so that the
        printed number is exact.
    """
    level = float(np.median(list(bright)))
    return round(math.log2(_SHOWN / level), 2) if level > 0 else 0.0


def chosen_exposure(asked: float | Literal["auto"], bright: Iterable[float]) -> float:
    """The exposure in EV that a configuration asks for, where ``auto`` is that of :func:`auto_exposure`."""
    return auto_exposure(bright) if asked == "auto" else asked


def white_of(exposure: float) -> float:
    """The smallest value in 1/sr that an exposure in EV shows as white."""
    return 2.0**-exposure


def to_display(value: ArrayLike, exposure: float) -> NDArray[np.uint8]:
    """8-bit sRGB of linear values (..., 3) in 1/sr at an exposure in EV."""
    linear = np.clip(np.asarray(value, np.float64) * 2.0**exposure, 0, 1)
    return np.round(255.0 * linear_to_srgb(linear)).astype(np.uint8)


def describe_exposure(exposure: float) -> str:
    """``exposure +1.65 EV (0.319 1/sr, albedo 1, is white)``."""
    white = white_of(exposure)
    return f"exposure {exposure:+.2f} EV ({white:.3g} 1/sr, albedo {math.pi * white:.2g}, is white)"


U8 = NDArray[np.uint8]
Palette = Literal["local", "flip", "signed"]
# Color maps of magnitudes from 0 to 1. Both are perceptually uniform, with monotonic lightness.
_MAGNITUDES = {"local": "viridis", "flip": "magma"}
# A group of maps that exceeds the median one by this factor does not widen the common scale.
_OUTLIER = 4.0
# sRGB colors of a signed difference from -1 (blue) over 0 (nearly black) to 1 (orange). Lightness encodes the
# magnitude. Blue and orange are distinguishable under every common color-vision deficiency.
_STOPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
_COLORS = ((199, 233, 255), (34, 136, 209), (13, 15, 20), (214, 98, 16), (255, 232, 189))


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


def tick_labels(low: float, high: float, factor: float = 1.0) -> list[str]:
    """Five evenly spaced numbers of a color bar, times a factor to its unit."""
    return [f"{factor * x:.3g}".replace("-", "−") for x in np.linspace(low, high, 5)]


def robust_scale(groups: Sequence[Sequence[ArrayLike]]) -> float:
    """Rounded end of the common scale of several groups of maps, such as those of each fit: the 99th
    percentile of the magnitudes of a group, and the largest over the groups that do not exceed four times the
    median one."""
    extents = sorted(map(_extent, groups))
    median = extents[(len(extents) - 1) // 2]
    return round_scale(max(x for x in extents if x <= _OUTLIER * median or x == median))


def _extent(maps: Sequence[ArrayLike]) -> float:
    return float(np.percentile(np.concatenate([np.abs(np.ravel(m)) for m in maps]), 99))

"""Palettes and scales of maps: magnitudes, and signed differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


def common_scale(maps: Sequence[ArrayLike]) -> float:
    """Rounded end of the scale of several maps: the 99th percentile of all magnitudes."""
    return round_scale(_extent(maps))


def robust_scale(groups: Sequence[Sequence[ArrayLike]]) -> float:
    """Rounded end of the common scale of several groups of maps, such as those of each fit: the 99th
    percentile of the magnitudes of a group, and the largest over the groups that do not exceed four times the
    median one."""
    extents = sorted(map(_extent, groups))
    median = extents[(len(extents) - 1) // 2]
    return round_scale(max(x for x in extents if x <= _OUTLIER * median or x == median))


def _extent(maps: Sequence[ArrayLike]) -> float:
    return float(np.percentile(np.concatenate([np.abs(np.ravel(m)) for m in maps]), 99))

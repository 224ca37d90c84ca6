"""Error maps, their color maps and scales, and the ticks of their color bars."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

Palette = Literal["local", "flip", "signed"]
# Color maps of magnitudes from 0 to 1. Both are perceptually uniform, with monotonic lightness.
_MAGNITUDES = {"local": "viridis", "flip": "magma"}
# sRGB colors of a signed difference from -1 (blue) over 0 (nearly black) to 1 (orange). Lightness encodes the
# magnitude. Blue and orange are distinguishable under every common color-vision deficiency.
_STOPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
_COLORS = ((199, 233, 255), (34, 136, 209), (13, 15, 20), (214, 98, 16), (255, 232, 189))
# Standard deviation in pixels of the averaging window.
WINDOW = 2.0


@cache
def palette(name: Palette) -> tuple[tuple[int, int, int], ...]:
    """256 sRGB colors for magnitudes from 0 to 1, or for signed values from -1 to 1."""
    if name == "signed":
        t = np.linspace(-1.0, 1.0, 256)
        table = np.stack([np.interp(t, _STOPS, channel) for channel in zip(*_COLORS, strict=True)], axis=-1)
    else:
        from matplotlib import colormaps

        table = 255.0 * np.asarray(colormaps[_MAGNITUDES[name]](np.linspace(0.0, 1.0, 256)))[:, :3]
    return tuple((r, g, b) for r, g, b in np.round(table).astype(int).tolist())


def gradient(name: Palette) -> str:
    """CSS gradient of a palette, with the lower end on the left."""
    colors = [palette(name)[i] for i in np.linspace(0, 255, 17).round().astype(int)]
    return f"linear-gradient(90deg, {', '.join(f'rgb({r} {g} {b})' for r, g, b in colors)})"


def indices(field: ArrayLike, name: Palette) -> U8:
    """Palette indices of values, clipped to the palette's range; NaN counts as 0."""
    x = np.nan_to_num(np.asarray(field, np.float64))
    if name == "signed":
        x = 0.5 * (x + 1.0)
    return np.round(255.0 * np.clip(x, 0.0, 1.0)).astype(np.uint8)


def local_error(picture: F32, value_a: F32, value_b: F32) -> F64:
    """Local noise-free root mean square error (rows, columns) in 1/sr.

    The root of the Gaussian average (σ = 2 pixels) of the mean over channels of ``(p-a)(p-b)``. Single
    products are often negative where the error is small compared to the noise, so they are averaged. The
    map is 0 where the average is negative: the error lies below the noise.
    """
    from scipy.ndimage import gaussian_filter

    p, a, b = (np.asarray(x, np.float64) for x in (picture, value_a, value_b))
    squared: F64 = gaussian_filter(((p - a) * (p - b)).mean(axis=-1), WINDOW, mode="nearest")
    return np.sqrt(np.maximum(squared, 0.0))


def round_scale(x: float) -> float:
    """Smallest of 1, 2, 5 times a power of ten that is not below x; 1 if x is not positive."""
    if not x > 0 or not math.isfinite(x):
        return 1.0
    power = 10.0 ** math.floor(math.log10(x))
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= x * (1 - 1e-9))


def common_scale(fields: Sequence[ArrayLike]) -> float:
    """Rounded end of the scale of several maps: the 99th percentile of all magnitudes."""
    return round_scale(float(np.percentile(np.concatenate([np.abs(np.ravel(f)) for f in fields]), 99)))


def color_bar(
    key: Palette, title: str, high: float, unit: str, note: str, factor: float = 1.0
) -> dict[str, Any]:
    """A labeled color bar with five evenly spaced numbers.

    Parameters
    ----------
    high : end of the scale; `factor` converts it to `unit`
    note : definition of the quantity
    """
    low = -high if key == "signed" else 0.0
    ticks = [f"{factor * x:.3g}".replace("-", "−") for x in np.linspace(low, high, 5)]
    bar = {"key": key, "title": title, "gradient": gradient(key), "ticks": ticks}
    return {**bar, "unit": unit, "note": note}

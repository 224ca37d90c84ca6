"""Statistics of heights: slopes of the mesh, size of detail, repetition within the tile."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.tile.heights.grid import HeightGrid

# A repetition is a peak of the autocorrelation of at least the first value after a dip below the second.
_PEAK, _DIP = 0.8, 0.5
_SHORTEST = 4


def triangle_slopes(grid: HeightGrid) -> NDArray[np.float64]:
    """Slopes |∇z| of all triangles of the periodic mesh (2·H·W,); all cover the same part of the plane."""
    rows, columns = grid.z.shape
    z = grid.z
    right, low = np.roll(z, -1, 1), np.roll(z, -1, 0)
    low_right = np.roll(low, -1, 1)
    per_x, per_y = float(columns), rows / grid.aspect
    first = np.hypot((low_right - low) * per_x, (z - low) * per_y)
    second = np.hypot((right - z) * per_x, (right - low_right) * per_y)
    return np.concatenate([first.ravel(), second.ravel()])


def slope_angles(grid: HeightGrid) -> tuple[float, float, float]:
    """Median, 99th percentile and maximum of the triangles' slopes, degrees."""
    slopes = triangle_slopes(grid)
    median, high = np.percentile(slopes, (50, 99))
    return tuple(float(np.degrees(np.arctan(s))) for s in (median, high, slopes.max()))  # type: ignore[return-value]


def rms_slope(grid: HeightGrid) -> float:
    """Root mean square of the triangles' slopes."""
    rows, columns = grid.z.shape
    # Every edge along an axis belongs to one triangle of either kind.
    along_u = np.mean((np.roll(grid.z, -1, 1) - grid.z) ** 2) * columns**2
    along_v = np.mean((np.roll(grid.z, -1, 0) - grid.z) ** 2) * (rows / grid.aspect) ** 2
    return float(np.sqrt(along_u + along_v))


def autocorrelation(height: NDArray[np.floating[Any]], axis: int) -> NDArray[np.float64]:
    """Periodic autocorrelation of heights (H, W) at lags 0 … half the size along an axis; 1 at lag 0.

    All zeros beyond lag 0 for constant heights.
    """
    size = height.shape[axis]
    lines = np.moveaxis(np.asarray(height, np.float64), axis, -1)
    power = np.abs(np.fft.rfft(lines - lines.mean(), axis=-1)) ** 2
    covariance = np.fft.irfft(power.mean(axis=0), size)[: size // 2 + 1]
    return covariance / covariance[0] if covariance[0] > 0 else np.eye(1, len(covariance))[0]


def detail_size(height: NDArray[np.floating[Any]]) -> float:
    """Half width of the autocorrelation in texels, interpolated, the smaller one of both axes."""
    return min(_half_width(autocorrelation(height, axis)) for axis in (0, 1))


def _half_width(correlation: NDArray[np.float64]) -> float:
    below = np.nonzero(correlation < 0.5)[0]
    if not len(below):
        return float(len(correlation))
    before = int(below[0]) - 1
    drop = correlation[before] - correlation[before + 1]
    return before + float((correlation[before] - 0.5) / drop)


def repeats(height: NDArray[np.floating[Any]], axis: int) -> int:
    """Number of repetitions of heights (H, W) along an axis within the tile; 1 without repetition.

    Found at the first lag at which the autocorrelation peaks at 0.8 or more after falling below 0.5.
    """
    correlation = autocorrelation(height, axis)
    dip = np.nonzero(correlation < _DIP)[0]
    if not len(dip):
        return 1
    # It is even about half the size, where a map that repeats twice has its peak.
    beyond = correlation[-1] if height.shape[axis] % 2 else correlation[max(-2, -len(correlation))]
    inner = correlation[1:]
    after = np.append(correlation[2:], beyond)
    peak = (inner >= _PEAK) & (inner >= correlation[:-1]) & (inner >= after)
    lags = np.nonzero(peak)[0] + 1
    lags = lags[(lags > dip[0]) & (lags >= _SHORTEST)]
    return max(1, round(height.shape[axis] / lags[0])) if len(lags) else 1

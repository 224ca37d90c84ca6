"""Periodic maps: other resolutions, and 8-bit heights without their steps.

A map's first two axes are rows and columns, row 0 the side ``v → 1``, texel centers at
``((i+½)/W, 1-(j+½)/H)``. Everything wraps around in both directions.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Enlargement = Literal["linear", "cubic"]

# Scales, in texels, that the steps of quantized heights are smoothed on, fine to coarse.
_SCALES = tuple(0.5 * 2.0 ** (i / 2.0) for i in range(13))
# Smoothing is applied where it moves heights by no more than rounding does (RMS, in units of the standard
# deviation of rounding): fully below the first number, not at all above the second.
_BELIEVED = (0.9, 1.05)


def resample(
    image: NDArray[np.floating[Any]], rows: int, columns: int, enlarge: Enlargement = "linear"
) -> NDArray[np.floating[Any]]:
    """Resample a periodic map (H, W, ...) to (rows, columns, ...), each axis separately, in its own dtype.

    Fewer texels: the box filter, which preserves the mean. More texels: interpolation at the new texel
    centers, which preserves the mean for integer factors: ``linear`` by the tent, which stays within the
    range of the data, ``cubic`` by the kernel of Keys (1981) with a = -1/2, which has continuous slopes and
    may overshoot. Edges wrap; texel centers do not shift. A ValueError where a map would be empty.
    """
    if rows < 1 or columns < 1:
        raise ValueError(f"a map needs at least one row and column, not {rows} x {columns}")
    out = image
    for axis, size in ((0, rows), (1, columns)):
        if out.shape[axis] != size:
            out = _along(out, axis, *_weights(out.shape[axis], size, enlarge))
    return out


def shrink(image: NDArray[np.floating[Any]], factor: int) -> NDArray[np.floating[Any]]:
    """Average about `factor` × `factor` texels of a map (H, W, ...), at most all of its rows or columns."""
    rows, columns = (max(1, n // factor) for n in image.shape[:2])
    return resample(image, rows, columns)


def _weights(old: int, new: int, enlarge: Enlargement) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Old texels (new, taps) that each new texel takes, and their weights (new, taps), rows summing to 1."""
    if new < old:
        start = np.arange(new) * old / new
        first = np.floor(start + 1e-9).astype(np.intp)
        index = first[:, None] + np.arange(-(-old // new) + 1)
        end = start + old / new
        covered = np.minimum(index + 1.0, end[:, None]) - np.maximum(index, start[:, None])
        weights = np.maximum(covered, 0.0)
    else:
        position = (np.arange(new) + 0.5) * old / new - 0.5
        taps = np.arange(2) if enlarge == "linear" else np.arange(-1, 3)
        index = np.floor(position).astype(np.intp)[:, None] + taps
        distance = np.abs(position[:, None] - index)
        weights = np.maximum(1.0 - distance, 0.0) if enlarge == "linear" else _keys(distance)
    return index % old, weights / weights.sum(axis=1, keepdims=True)


def _keys(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cubic convolution kernel with a = -1/2 at distances x ≥ 0 (Keys 1981, equation 15)."""
    inner = (1.5 * x - 2.5) * x * x + 1.0
    outer = ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0
    return np.where(x < 1.0, inner, np.where(x < 2.0, outer, 0.0))


def _along(
    image: NDArray[np.floating[Any]], axis: int, index: NDArray[np.intp], weights: NDArray[np.float64]
) -> NDArray[np.floating[Any]]:
    shape = [1] * image.ndim
    shape[axis] = len(index)
    total = np.zeros((*image.shape[:axis], len(index), *image.shape[axis + 1 :]), np.float64)
    for tap in range(index.shape[1]):
        total += np.take(image, index[:, tap], axis=axis) * weights[:, tap].reshape(shape)
    return total.astype(image.dtype)


def dequantize(height: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Smooth heights (H, W) that were rounded to multiples of `step`, within what the rounding allows.

    Quantization turns gentle slopes into terraces. Every surface within half a step of the stored one is
    consistent with the file. We choose, per texel, the coarsest smoothing that is consistent with rounding:
    rounding moves heights by ``step/√12`` (root mean square), and smoothing that moves them by more, locally,
    removes detail. The smoothing is a periodic Gaussian g applied as ``2g - g²``, which preserves curvature.
    Finally, heights are clipped to half a step about the stored ones. The step has the unit of the heights,
    such as 1/255 for 8-bit images.
    """
    if not step > 0:
        raise ValueError(f"step must be positive, not {step}")
    low, high = (limit**2 for limit in _BELIEVED)
    # In units of the step and relative to a stored height: constants stay exact, single precision suffices.
    stored = ((height - height[0, 0]) / step).astype(np.float32)
    spectrum = np.fft.rfft2(stored)
    out = stored.copy()
    for scale in _SCALES:
        transfer = _gaussian(height.shape, scale)
        smooth = np.fft.irfft2(spectrum * (transfer * (2.0 - transfer)), height.shape)
        moved = np.fft.rfft2((smooth - stored) ** 2) * _gaussian(height.shape, 2.0 * scale)
        belief = np.clip((high - 12.0 * np.fft.irfft2(moved, height.shape)) / (high - low), 0.0, 1.0)
        if not belief.any():
            break  # coarser smoothing moves heights further
        out += belief * (smooth - out)
    moved_by = np.clip(out - stored, -0.5, 0.5).astype(np.float64)
    return height + step * moved_by


def _gaussian(shape: tuple[int, ...], scale: float) -> NDArray[np.float32]:
    """Transfer function of a periodic Gaussian of standard deviation `scale` texels, for ``rfft2``."""
    rows, columns = np.fft.fftfreq(shape[0]), np.fft.rfftfreq(shape[1])
    spread = -2.0 * (np.pi * scale) ** 2
    transfer = np.exp(spread * rows**2)[:, None] * np.exp(spread * columns**2)
    return transfer.astype(np.float32)

"""The transfer curve of sRGB (IEC 61966-2-1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


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

"""Normal maps that store only x and y: two-channel compression (BC5), and x in alpha, y in green (DXT5nm)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

# Blue is no z where it differs from √(1 - x² - y²), on average, by more than its own standard deviation and
# this, which rounding explains, and correlates with it by less than the second number.
_ROUNDING, _UNRELATED = 0.005, 0.3
# Standard deviation of a constant channel, with the rounding of JPG images.
_CONSTANT = 0.02
# Blue of empty maps is below the first number: -1, and the rounding of JPG images. Gray blue (0) makes flat
# normals shorter than the second.
_EMPTY, _SHORT = -0.9, 0.1
# Texels that decide, about.
_DECIDING = 1 << 20


def stored_xy(vectors: Array) -> tuple[list[int], str] | None:
    """The channels of x and y in a normal map that stores no z, and the same in words.

    Blue is no z where it neither equals √(1 - x² - y²) nor varies with it. In such maps x is in alpha if red
    and blue are constant or equal green, and alpha is not constant.

    Parameters
    ----------
    vectors : (H, W, C), components of the normals in [-1, 1], C = 2: x and y; 3: RGB; 4: RGBA. Of large maps,
        some decide.

    Returns
    -------
    (list of int, str) or None
        None where the map stores z.
    """
    if vectors.shape[2] == 2:
        return [0, 1], "x and y"
    step = max(1, round(math.sqrt(vectors[..., 0].size / _DECIDING)))
    vectors = vectors[::step, ::step]
    red, green, blue = (vectors[..., i] for i in range(3))
    z = height_of(vectors[..., :2])
    if float(np.mean(np.abs(z - blue))) <= _ROUNDING + float(blue.std()):
        return None
    alone = all(_constant(channel) or np.array_equal(channel, green) for channel in (red, blue))
    if alone and vectors.shape[2] == 4 and np.ptp(vectors[..., 3]) > 0:
        return [3, 1], "x in alpha and y in green"
    deviations = float(z.std()), float(blue.std())
    related = float(np.mean((z - z.mean()) * (blue - blue.mean()))) > _UNRELATED * math.prod(deviations)
    unrelated = deviations[0] > 0 and not (deviations[1] > 0 and related)
    if unrelated or blue.max() < _EMPTY or np.square(vectors[..., :3]).sum(axis=-1).max() < _SHORT**2:
        return [0, 1], "x in red and y in green"
    return None


def height_of(xy: Array) -> Array:
    """z = √(1 - x² - y²) of unit normals (H, W, 2) that point up; 0 where x² + y² exceeds 1."""
    return np.asarray(np.sqrt(np.maximum(0.0, 1.0 - np.square(xy).sum(axis=-1))))


def _constant(channel: Array) -> bool:
    return float(channel.std()) <= _CONSTANT

"""Directions: unit vectors in the tile's frame, ``z`` the reference plane's normal.

``omega_i`` points from the surface towards the light, ``omega_o`` towards the viewer; both have ``z > 0``.
The projected disk is the orthographic image of the hemisphere, ``(x, y)`` of the unit vector.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.errors import InputError

# Edges of the bands of cos θ in which errors are reported.
ELEVATION_BANDS: tuple[float, ...] = (0.0, 0.2, 0.4, 0.7, 1.0)

# Largest difference of a unit vector's length from 1: half precision rounds by less.
_ROUNDING = 1e-3


def check_unit(omega: ArrayLike, name: str, *, above: bool = False) -> None:
    """Refuse directions (..., 3) that are not unit vectors, or, with `above`, have no z > 0.

    Raises
    ------
    InputError : with the number of such directions, and the first length or z
    """
    found = np.asarray(omega, np.float64).reshape(-1, 3)
    length, z = np.linalg.norm(found, axis=-1), found[:, 2].astype(np.float32)
    normalize = "normalize them: mbtf_core.directions.normalize"
    for good, expected, what, values, hint in (
        (np.abs(length - 1.0) <= _ROUNDING, "unit vectors", "the length", length, normalize),
        ((z > 0) | (not above), "above the plane", "z =", z, "leave them out: they have no values"),
    ):
        if not good.all():
            at = int(good.argmin())
            text = f"{np.sum(~good)} of {len(good)} directions are not {expected}; the first, at index {at}, "
            raise InputError(f"{text}has {what} {values[at]:.4g}", where=name, hint=hint)


def from_projected_disk(xy: ArrayLike) -> NDArray[np.float64]:
    """Lift points of the projected disk to unit vectors.

    Parameters
    ----------
    xy : (..., 2) array_like
        Points (x, y); outside the unit disk z is 0.

    Returns
    -------
    (..., 3) float64 array
        Vectors with z ≥ 0.
    """
    p = np.asarray(xy, np.float64)
    z = np.sqrt(np.maximum(0.0, 1.0 - p[..., 0] ** 2 - p[..., 1] ** 2))
    return np.concatenate([p, z[..., None]], axis=-1)


def from_angles(elevation_deg: ArrayLike, azimuth_deg: ArrayLike) -> NDArray[np.float64]:
    """Unit vectors from elevation and azimuth.

    Parameters
    ----------
    elevation_deg : angle above the reference plane in degrees
    azimuth_deg : angle from +u towards +v in degrees; broadcast with the elevation

    Returns
    -------
    (..., 3) float64 array
    """
    e, a = np.broadcast_arrays(np.radians(elevation_deg), np.radians(azimuth_deg))
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)


def normalize(omega: ArrayLike) -> NDArray[np.float64]:
    """Scale vectors to unit length.

    Parameters
    ----------
    omega : (..., 3) array_like
        Vectors of any nonzero length.

    Returns
    -------
    (..., 3) float64 array
    """
    w = np.asarray(omega, np.float64)
    return w / np.linalg.norm(w, axis=-1, keepdims=True)

"""What the readers of measured BTFs and of other programs' data sets have in common.

Directions are unit vectors of our frame: x along u, y along v, which is up in images, and z the normal. They
point towards the light and towards the viewer. Files are untrusted: a reader checks what a file claims
before it allocates memory for it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.lattice import MAX_LEVEL
from mbtf_core.errors import InputError

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]

# Directions that are lower than this above the reference plane count as below it.
HORIZON = 1e-4
# Most pairs of light and view; most texels of an image, and along one of its sides.
MOST_PAIRS = 10_000_000
MOST_TEXELS = 1 << 26
MOST_ACROSS = 1 << MAX_LEVEL
# Hint for a damaged file.
COMPLETE = "check that the file is complete"


class MeasuredBtf(ABC):
    """Images of a material under many pairs of light and view.

    Parameters
    ----------
    path : the file or folder
    rows, columns : texels of an image; row 0 is the top
    light, view : (pairs, 3), unit vectors of all pairs of the file; those at the horizon or below it are left
        out

    Attributes
    ----------
    cosine : whether the values include the cosine of the light; None: the file does not say
    at_once : values that one call should read: many where each image is decoded as a whole
    left_out : pairs that are left out
    """

    cosine: bool | None = None
    at_once = 1 << 24

    def __init__(self, path: Path, rows: int, columns: int, light: F32, view: F32) -> None:
        self.path, self.rows, self.columns = path, rows, columns
        above = (light[:, 2] > HORIZON) & (view[:, 2] > HORIZON)
        self._number = np.flatnonzero(above)
        self.light, self.view, self.left_out = light[above], view[above], int((~above).sum())

    def values(self, pair: I64, texel: I64) -> F32:
        """Values (n, 3) at texels (n,), row-major, of pairs (n,), as stored, linear RGB with Rec.709
        primaries; each image is decoded once per call. An InputError if one is NaN or infinite."""
        out = self._values(self._number[pair], np.asarray(texel))
        bad = int((~np.isfinite(out).all(axis=-1)).sum())
        if bad:
            what = f"has NaN or infinite values ({bad} of {len(out)} that were read)"
            raise InputError(what, where=self.path)
        return out

    @abstractmethod
    def _values(self, number: I64, texel: I64) -> F32:
        """Values (n, 3) at texels of pairs, which have their number in the file."""


def from_angles(theta: NDArray[np.floating[Any]], phi: NDArray[np.floating[Any]]) -> F32:
    """Unit vectors (n, 3) of polar angles (n,) from the normal and azimuths (n,) from x to y, in radians."""
    theta, phi = np.asarray(theta, np.float64), np.asarray(phi, np.float64)
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], axis=-1).astype(np.float32)


def from_plane(xy: NDArray[np.floating[Any]]) -> F32:
    """Unit vectors (n, 3) of the upper hemisphere whose x and y are given, (n, 2).

    Where x² + y² is 1 or more, z is 0 and the vector is not of unit length.
    """
    wide = np.asarray(xy, np.float64)
    z = np.sqrt(np.maximum(1.0 - (wide * wide).sum(axis=-1), 0.0))
    return np.concatenate([wide, z[..., None]], axis=-1).astype(np.float32)


def check_texels(rows: int, columns: int, path: Path) -> None:
    """Refuse measured BTFs without texels, and those that are too large."""
    if min(rows, columns) < 1 or max(rows, columns) > MOST_ACROSS or rows * columns > MOST_TEXELS:
        raise InputError(
            f"claims images of {columns} x {rows} texels; 1 to {MOST_ACROSS:,} across are read, "
            f"{MOST_TEXELS:,} at most",
            where=path,
        )

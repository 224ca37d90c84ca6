"""What the readers of measured BTFs and of other programs' data sets have in common.

Directions are unit vectors of our frame: x along u, y along v, which is up in images, and z the normal. They
point towards the light and towards the viewer. Files are untrusted: a reader checks what a file claims
before it allocates memory for it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol, TypedDict

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
# Values to read at once from images that are decoded as a whole.
MANY = 1 << 24


class MeasuredBtf(Protocol):
    """Images of a material under many pairs of light and view."""

    @property
    def rows(self) -> int:
        """Texels of a column of an image; row 0 is the top."""

    @property
    def columns(self) -> int:
        """Texels of a row of an image."""

    @property
    def light(self) -> F32:
        """Unit vectors (pairs, 3) towards the light; z > 0."""

    @property
    def view(self) -> F32:
        """Unit vectors (pairs, 3) towards the viewer; z > 0."""

    @property
    def left_out(self) -> int:
        """Pairs of the file whose light or view is at the horizon or below it."""

    @property
    def cosine(self) -> bool | None:
        """Do the values include the cosine of the light? None: the file does not say."""

    @property
    def at_once(self) -> int:
        """Number of values that one call should read: many where each image is decoded as a whole."""

    def values(self, pair: NDArray[np.integer[Any]], texel: NDArray[np.integer[Any]]) -> F32:
        """Values at texels (n,), row-major, of pairs (n,).

        Each image is decoded once per call.

        Returns
        -------
        (n, 3) float32 array
            As stored, linear RGB with Rec.709 primaries.

        Raises
        ------
        InputError
            The file cannot be read, or one of the values is NaN or infinite.
        """


class QueryBlock(TypedDict):
    """Queries in the conventions of our data sets; the fields are parallel arrays.

    Attributes
    ----------
    query : (n,) int64 array
        Number of each query in its file.
    u : (n, 2) float32 array
        Position in [0, 1)².
    sigma : (n,) float32 array
        Standard deviation of the footprint in tile widths.
    omega_i, omega_o : (n, 3) float32 array
        Unit vectors towards the light and the viewer; z > 0.
    value : (n, 3) float32 array
        Radiance in 1/sr under an irradiance of 1 on the reference plane; linear RGB.
    """

    query: I64
    u: F32
    sigma: F32
    omega_i: F32
    omega_o: F32
    value: F32


class MeasuredQueries(Protocol):
    """A list of queries."""

    @property
    def count(self) -> int:
        """Queries of the file."""

    def read(self, start: int, stop: int) -> QueryBlock:
        """Queries from `start` to before `stop`.

        Queries that cannot be used are left out: NaN or infinite numbers, a direction at the horizon or
        below it, a footprint without size. The field `query` has the numbers of the others.
        """


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
    """Refuse images without texels, and images that are too large."""
    if rows < 1 or columns < 1:
        raise InputError(f"claims images of {columns} x {rows} texels", where=path)
    if max(rows, columns) > MOST_ACROSS:
        raise InputError(
            f"claims {columns} x {rows} texels; at most {MOST_ACROSS:,} across are read", where=path
        )
    if rows * columns > MOST_TEXELS:
        raise InputError(f"claims {columns} x {rows} texels; at most {MOST_TEXELS:,} are read", where=path)


def check_indices(
    pair: NDArray[np.integer[Any]], texel: NDArray[np.integer[Any]], pairs: int, texels: int
) -> tuple[I64, I64]:
    """Both arrays as int64 (n,).

    Raises
    ------
    IndexError
        One of them is out of range: a fault of the caller.
    """
    i, j = np.atleast_1d(pair).astype(np.int64), np.atleast_1d(texel).astype(np.int64)
    if i.shape != j.shape or i.ndim != 1:
        raise IndexError(f"pairs {i.shape} and texels {j.shape} differ")
    for numbers, count, name in ((i, pairs, "pair"), (j, texels, "texel")):
        if numbers.size and (numbers.min() < 0 or numbers.max() >= count):
            raise IndexError(f"a {name} is not in 0..{count - 1}")
    return i, j


def check_finite(values: F32, where: object) -> F32:
    """The values (n, 3), all of which must be finite."""
    bad = int((~np.isfinite(values).all(axis=-1)).sum())
    if bad:
        raise InputError(f"has NaN or infinite values ({bad} of {len(values)} that were read)", where=where)
    return values

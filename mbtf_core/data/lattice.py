r"""Levels of detail, footprints and the lattice of texels.

The tile is ``uv ∈ [0,1)²``; its width is the unit of length and its height is the aspect ``a = H/W``.
Level ``s`` has ``2^s`` texels across and ``max(1, round(a·2^s))`` texels down; its footprint is the isotropic
Gaussian of standard deviation ``σ_s = 2^-s / 2`` tile widths, half a texel. A footprint σ has the fractional
level ``l = -log2(2σ)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

MAX_LEVEL = 14


def sigma_of_level(level: ArrayLike) -> NDArray[np.float64]:
    """Footprint of a level of detail.

    Parameters
    ----------
    level : fractional levels l, any shape

    Returns
    -------
    float64 array
        Standard deviation ``2^-l / 2`` in tile widths.
    """
    return 0.5 * np.exp2(-np.asarray(level, np.float64))


def level_of_sigma(sigma: ArrayLike) -> NDArray[np.float64]:
    """Fractional level of a footprint, the inverse of :func:`sigma_of_level`.

    Parameters
    ----------
    sigma : standard deviations σ in tile widths, any shape

    Returns
    -------
    float64 array
        ``-log2(2σ)``, not clamped.
    """
    return -np.log2(2.0 * np.asarray(sigma, np.float64))


@dataclass(frozen=True)
class Lattice:
    """The texel grids of one tile.

    Attributes
    ----------
    finest : finest level k, 0 to 14
    aspect : height of the tile over its width, ``a = H/W``

    Raises
    ------
    ValueError : `finest` or `aspect` is out of range
    """

    finest: int
    aspect: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.finest <= MAX_LEVEL:
            raise ValueError(f"finest level must lie in 0..{MAX_LEVEL}, not {self.finest}")
        if not self.aspect > 0:
            raise ValueError(f"aspect must be positive, not {self.aspect}")

    @classmethod
    def for_map(cls, rows: int, columns: int, finest: int | None = None) -> Lattice:
        """Lattice of a map.

        Parameters
        ----------
        rows, columns : size of the map in pixels
        finest : finest level k; by default ``floor(log2(columns))``, at most 14
        """
        k = min(int(columns).bit_length() - 1, MAX_LEVEL) if finest is None else finest
        return cls(k, rows / columns)

    def shape(self, level: int | None = None) -> tuple[int, int]:
        """(rows, columns) of texels of a level; of the finest level by default."""
        s = self.finest if level is None else level
        return max(1, round(self.aspect * 2**s)), 2**s

    def texels(self, level: int | None = None) -> int:
        """Number of texels of a level; of the finest level by default."""
        rows, columns = self.shape(level)
        return rows * columns

    def texel_of(self, u: NDArray[np.floating[Any]]) -> NDArray[np.int64]:
        """Numbers (n,) of the finest level's texels, row by row from the side v → 1, at uv positions (n, 2)
        in [0, 1)."""
        rows, columns = self.shape()
        column, above = np.floor(u.astype(np.float64) * (columns, rows)).astype(np.int64).T
        return np.asarray((rows - 1 - above) * columns + column)

    @property
    def sigma_range(self) -> tuple[float, float]:
        """Footprints of the finest level and of level 0, in tile widths."""
        return float(sigma_of_level(self.finest)), float(sigma_of_level(0))


def texel_centers(rows: int, columns: int) -> NDArray[np.float64]:
    """uv of the texel centers of a map, shape (rows, columns, 2): row 0 is the side ``v → 1``."""
    u = (np.arange(columns) + 0.5) / columns
    v = 1.0 - (np.arange(rows) + 0.5) / rows
    return np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1)

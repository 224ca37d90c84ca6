r"""Levels of detail, footprints and the lattice of texels.

The tile is ``uv ∈ [0,1)²``; its width is the unit of length and its height is the aspect ``a = H/W``.
Level ``s`` has ``2^s`` texels across and ``max(1, round(a·2^s))`` texels down; its footprint is the isotropic
Gaussian of standard deviation ``σ_s = 2^-s / 2`` tile widths, half a texel. A footprint σ has the fractional
level ``l = -log2(2σ)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

MAX_LEVEL = 14


def sigma_of_level(level: ArrayLike) -> NDArray[np.float64]:
    """Standard deviation, in tile widths, of the footprint of a (fractional) level. Any shape."""
    return 0.5 * np.exp2(-np.asarray(level, np.float64))


def level_of_sigma(sigma: ArrayLike) -> NDArray[np.float64]:
    """Fractional level ``-log2(2σ)`` of footprints σ in tile widths. Any shape; not clamped."""
    return -np.log2(2.0 * np.asarray(sigma, np.float64))


@dataclass(frozen=True)
class Lattice:
    """The texel grids of one tile.

    Attributes
    ----------
    finest : the finest level k
    aspect : height of the tile over its width, ``a = H/W``
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
        """Lattice of a map of `rows` × `columns` pixels; by default ``k = floor(log2(columns))``, at most
        14."""
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

    @property
    def sigma_range(self) -> tuple[float, float]:
        """Smallest and largest footprint of the data: those of the finest level and of level 0."""
        return float(sigma_of_level(self.finest)), float(sigma_of_level(0))

    def blend(self, sigma: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Levels to blend for footprints σ: (coarser, finer, weight of the finer), each of σ's shape.

        The level is clamped to [0, k]; the weights are ``1 - frac(l)`` and ``frac(l)``.
        """
        level = np.clip(level_of_sigma(sigma), 0.0, self.finest)
        coarse = np.minimum(np.floor(level), max(self.finest - 1, 0)).astype(np.int64)
        return coarse, np.minimum(coarse + 1, self.finest), level - coarse


def texel_centers(rows: int, columns: int) -> NDArray[np.float64]:
    """uv of the texel centers of a map, shape (rows, columns, 2): row 0 is the side ``v → 1``."""
    u = (np.arange(columns) + 0.5) / columns
    v = 1.0 - (np.arange(rows) + 0.5) / rows
    return np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1)

"""M of a wall, whose visible and lit parts can be computed exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mbtf_gen.tile.heights import HeightGrid


@dataclass(frozen=True)
class Wall:
    """A thin wall along y on a floor: one of `columns` columns is high; its flanks are one cell wide.

    Attributes
    ----------
    columns : columns of the map
    slope : slope of the flanks
    albedo : of all facets
    """

    columns: int
    slope: float
    albedo: float

    @property
    def height(self) -> float:
        """Height of the wall in tile widths."""
        return self.slope / self.columns

    @property
    def grid(self) -> HeightGrid:
        """The heights."""
        row = np.full(self.columns, -self.height)
        row[self.columns // 3] = 0.0
        return HeightGrid(np.tile(row, (2, 1)), 1.0)

    def tile_mean_from_above(self, omega_i: ArrayLike) -> float:
        """Tile mean in 1/sr seen along the normal, for a light (3,) whose shadow ends before the next wall.

        Raises
        ------
        ValueError : the shadow reaches the next wall, or both flanks are lit
        """
        light = np.asarray(omega_i, np.float64)
        shadow, cell = self.height * abs(light[0]) / light[2], 1.0 / self.columns
        if not cell <= shadow <= 1.0 - cell:
            raise ValueError("the light is too low or too high for the closed form")
        floor = 1.0 - 2.0 * cell - (shadow - cell)
        flank = (self.slope * abs(light[0]) + light[2]) / (np.hypot(1.0, self.slope) * light[2])
        return float(self.albedo / np.pi * (floor + cell * flank))

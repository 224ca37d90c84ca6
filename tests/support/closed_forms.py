"""M of a wall and of a V-groove, whose visible and lit parts can be computed exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_gen.diagnostics import selftest
from mbtf_gen.tile.heights import HeightGrid

F64 = NDArray[np.float64]


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


class Groove(selftest.Groove):
    """The groove of the self-test, at each position."""

    def value(self, x: ArrayLike, omega_i: ArrayLike, omega_o: ArrayLike) -> F64:
        """B in 1/sr at positions x (any shape) on the reference plane, for directions (3,)."""
        light, view = np.asarray(omega_i, np.float64), np.asarray(omega_o, np.float64)
        position = np.asarray(x, np.float64)
        out = np.zeros_like(position)
        for side in (1, -1):
            seen, lit = self.reach(view, side), self.reach(light, side)
            if seen == 0:
                continue
            length = side / self.slope + view[0] / view[2]
            # Distance from the facet's ridge on the plane, in the direction in which the facet lies, 0 … 1.
            away = (position - 0.25) * np.sign(length) % 1.0
            depth = away / abs(length)
            out = np.where(depth <= min(seen, lit), self.radiance(light, side), out)
        return out

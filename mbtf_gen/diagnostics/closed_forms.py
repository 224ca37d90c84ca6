"""Scenes whose M is known in closed form, for ``mbtf-gen selftest`` and for tests.

The height fields are Lambertian under a delta light of unit irradiance on the reference plane, with direct
light alone. The radiance of a lit facet of normal n is ``albedo/π · (n·ω_i)/ω_i,z`` in every direction. The
lit and the visible part of a facet follow from straight lines past ridges in the cross-section.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_gen.tile.heights import HeightGrid

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Groove:
    """A symmetric V-groove along y: ridges at x = 1/4 + n, valleys at x = 3/4 + n.

    Attributes
    ----------
    depth : depth of the valleys, in tile widths
    albedo : of both facets
    """

    depth: float
    albedo: float

    @property
    def grid(self) -> HeightGrid:
        """The heights: two columns."""
        return HeightGrid(np.tile([0.0, -self.depth], (2, 1)), 1.0)

    @property
    def slope(self) -> float:
        """Slope of the facets."""
        return 2.0 * self.depth

    def reach(self, omega: F64, side: int) -> float:
        """Depth down to which the facet that descends towards `side`·x is visible from direction ω (3,)."""
        if side * self.slope * omega[0] + omega[2] <= 0:
            return 0.0
        # At depth d the facet is d/slope from its ridge; the opposite ridge, one tile on, is passed when
        # d/slope + d·ω_x/ω_z ≤ 1.
        run = 1.0 / self.slope + side * omega[0] / omega[2]
        return self.depth if run <= 0 else min(self.depth, 1.0 / run)

    def radiance(self, omega_i: F64, side: int) -> float:
        """Radiance of the lit part of the facet that descends towards `side`·x, in 1/sr."""
        cosine = (side * self.slope * omega_i[0] + omega_i[2]) / np.hypot(1.0, self.slope)
        return float(self.albedo / np.pi * max(0.0, cosine) / omega_i[2])

    def tile_mean(self, omega_i: ArrayLike, omega_o: ArrayLike) -> float:
        """Tile mean in 1/sr for directions (3,)."""
        light, view = np.asarray(omega_i, np.float64), np.asarray(omega_o, np.float64)
        total = 0.0
        for side in (1, -1):
            both = min(self.reach(light, side), self.reach(view, side))
            # The shadow of a facet's depth d on the reference plane, along the view.
            length = both * (1.0 / self.slope + side * view[0] / view[2])
            total += self.radiance(light, side) * length
        return total

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

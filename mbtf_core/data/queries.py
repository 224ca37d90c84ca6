"""Queries of M: position, footprint, light and view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Queries:
    """A batch of queries; the leading axes are ``(n,)`` or ``(items, rows, columns)``.

    Attributes
    ----------
    u : (..., 2) float32 array
        Positions on the reference plane, uv in [0, 1).
    sigma : (...) float32 array
        Standard deviations of the footprints, in tile widths.
    omega_i, omega_o : (..., 3) float32 arrays
        Unit vectors towards the light and towards the viewer.
    """

    u: F32
    sigma: F32
    omega_i: F32
    omega_o: F32

    @property
    def lead(self) -> tuple[int, ...]:
        """Shape of the leading axes."""
        return self.sigma.shape

    def flat(self) -> Queries:
        """The same queries with one leading axis."""
        return Queries(
            self.u.reshape(-1, 2),
            self.sigma.reshape(-1),
            self.omega_i.reshape(-1, 3),
            self.omega_o.reshape(-1, 3),
        )

    def take(self, rows: Any) -> Queries:
        """Select along the first axis by a slice, an index array or a mask."""
        return Queries(self.u[rows], self.sigma[rows], self.omega_i[rows], self.omega_o[rows])

"""What a tile of fibers shows from above: heights, coverage, directions, colors.

Vertical rays are traced to the fibers, one per vertex of a grid. Where a ray passes through, the height is
that of the lowest point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.geometry import FINEST_LEVEL, Geometry, mesh_slopes
from mbtf_core.data.lattice import Lattice
from mbtf_core.images.resample import resample
from mbtf_gen.tile.tracers.protocol import TileGeometry

# Level of the grid of heights: so many above the finest of the data, up to a level, at least that of maps.
_FINER, _USUAL = 3, 10
# Largest slope that counts: between two fibers it is that of a cliff.
_STEEPEST = 3.0

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Envelope:
    """What vertical rays meet, row 0 at the side ``v → 1``.

    Attributes
    ----------
    heights : (H, W) array in tile widths, at most 0
    aspect : height of the tile over its width
    covered : (H, W) array, 1 where a ray meets a fiber, else 0
    tangents : (H, W, 3) array of unit vectors along the fibers; 0 in gaps
    across : (H, W) array, u of the fibers' texture, which tells their yarn
    """

    heights: F64
    aspect: float
    covered: F64
    tangents: F64
    across: F64

    @classmethod
    def of(cls, fibers: TileGeometry, aspect: float, unit: float, lowest: float, finest: int) -> Envelope:
        """Trace fibers for data up to a level.

        Parameters
        ----------
        fibers : as :meth:`Tile.trace <mbtf_gen.tile.protocol.Tile.trace>` gives them, of an aspect and a unit
        lowest : height in gaps, in tile widths
        """
        import mitsuba as mi

        shape = Lattice(max(_map_level(finest), min(finest + _FINER, _USUAL)), aspect).shape()
        rows, columns = shape
        x = ((np.arange(columns) + 0.5) / columns - 0.5) * unit
        y = (0.5 - (np.arange(rows) + 0.5) / rows) * aspect * unit
        at = (a.astype(np.float32).ravel() for a in np.meshgrid(x, y))
        start = mi.Point3f(*at, np.full(rows * columns, unit, np.float32))
        ray, all_ = mi.Ray3f(start, mi.Vector3f(0.0, 0.0, -1.0)), mi.Mask(np.ones(rows * columns, bool))
        si, *_ = fibers.closest_hit(ray, all_, 1)
        covered = np.array(si.is_valid()).reshape(shape)
        heights = np.where(covered, np.array(si.p.z, np.float64).reshape(shape) / unit, lowest)
        tangents = np.moveaxis(np.array(si.sh_frame.t, np.float64).reshape(3, *shape), 0, -1)
        return cls(
            np.minimum(heights - heights.max(), 0.0),
            aspect,
            covered.astype(np.float64),
            np.where(covered[..., None], tangents, 0.0),
            np.where(covered, np.array(si.uv.x, np.float64).reshape(shape), 0.0),
        )

    def geometry(self, finest: int, colors: F64, variances: F64) -> Geometry:
        """Its geometry, with maps for data up to a level.

        Parameters
        ----------
        colors, variances : (yarns, 3) linear color and (yarns,) longitudinal variance of each yarn
        """
        shape = Lattice(_map_level(finest), self.aspect).shape()
        slopes = mesh_slopes(self.heights, self.aspect)
        slopes /= np.maximum(1.0, np.linalg.norm(slopes, axis=-1, keepdims=True) / _STEEPEST)
        (sx, sy), (x, y, z) = np.moveaxis(slopes, -1, 0), np.moveaxis(self.tangents, -1, 0)
        yarn = (self.across * len(colors)).astype(int)

        def mean(*channels: F64) -> NDArray[np.float32]:
            """Means over texels of some channels (H, W)."""
            return np.asarray(resample(np.stack(channels, -1), *shape), np.float32)

        return Geometry(
            self.heights.astype(np.float32),
            self.aspect,
            mean(sx, sy),
            mean(sx * sx, sx * sy, sy * sy),
            base_color=np.clip(mean(*np.moveaxis(colors[yarn], -1, 0) * self.covered), 0.0, 1.0),
            opacity=np.clip(mean(self.covered)[..., 0], 0.0, 1.0),
            tangent_moments=mean(x * x, x * y, x * z, y * y, y * z, z * z),
            longitudinal_variance=mean(variances[yarn] * self.covered)[..., 0],
        )


def _map_level(finest: int) -> int:
    """Level of the texels of the maps."""
    return min(finest + 1, FINEST_LEVEL)

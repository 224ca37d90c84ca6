"""Displaced periodic tile: heights on a grid → triangles.

Mesh vertices sit on texel centers of the grid, ``uv = ((i+½)/W, 1-(j+½)/H)``, heights are
``z = scale · h - max(scale · h)``, and the cell between the last and the first column (row) closes the
period. A mesh may have an apron of repeated cells around the period, so that a ray near its border meets
surface on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.geometry import mesh_slopes
from mbtf_core.errors import InputError
from mbtf_core.images.resample import resample
from mbtf_gen.config.generator import NormalMode, Tracer
from mbtf_gen.tile.tracers.protocol import TileGeometry

# Cells of a grid that Mitsuba traces. Each takes about 300 bytes, with Mitsuba's and Embree's own data.
MOST_CELLS = 1 << 24


@dataclass(frozen=True)
class HeightGrid:
    """Heights of one tile.

    Attributes
    ----------
    z : (H, W) float64 array
        Heights ≤ 0 in tile widths, maximum 0; row 0 is the side ``v → 1``.
    aspect : float
        H/W of the tile.
    tracer : {"heightfield", "mesh"}
        How rays find the surface: cell by cell, or by Mitsuba as triangles.
    """

    z: NDArray[np.float64]
    aspect: float
    tracer: Tracer = "heightfield"

    @classmethod
    def from_map(cls, heights: NDArray[np.float64], scale: float, aspect: float | None = None) -> HeightGrid:
        """Grid of a height map (H, W) of stored numbers: ``z = scale · h - max(scale · h)``, so that a
        negative scale inverts the heights; aspect H/W by default.
        """
        z = scale * np.asarray(heights, np.float64)
        rows, columns = z.shape
        return cls(z - z.max(), rows / columns if aspect is None else aspect)

    @property
    def displacement_range(self) -> float:
        """Largest height difference in tile widths."""
        return float(self.z.max() - self.z.min())

    def at(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Heights (...) of the triangles at places (..., 2), in cells along x and y from the first vertex of
        the lowest row."""
        z, cell = self.z[::-1], np.floor(places).astype(np.int64)
        x, y = np.moveaxis(places - cell, -1, 0)
        rows, columns = ((cell[..., k, None] + (0, 1)) % z.shape[1 - k] for k in (1, 0))
        a, b, c, d = (z[rows[..., j], columns[..., i]] for j in (0, 1) for i in (0, 1))
        return a + (b - a) * x + (c - a) * y + (d - b - c + a) * np.maximum(0.0, x + y - 1.0)

    def trace(self, unit: float, below: bool = False) -> TileGeometry:
        """The surface as rays meet it, see :meth:`mbtf_gen.tile.protocol.Tile.trace`; an InputError if
        Mitsuba would trace too many triangles."""
        if self.tracer == "heightfield":
            from mbtf_gen.tile.tracers.heightfield_tracer import HeightfieldGeometry

            return HeightfieldGeometry.of(self.z, self.aspect, unit, below)
        if self.z.size > MOST_CELLS:
            raise InputError(
                f"a mesh of {self.z.size:,} cells is too large for triangles; at most {MOST_CELLS:,} are",
                where="geometry.tracer",
                hint="reduce --mesh, or use --tracer heightfield",
            )
        from mbtf_gen.tile.tracers.mesh_tracer import MeshGeometry

        vertices = grid_vertices(self, (1, 1))
        return MeshGeometry.of_cells(vertices, grid_faces(*vertices.shape[:2]), self.aspect, unit)


def grid_vertices(grid: HeightGrid, apron: tuple[int, int] = (0, 0)) -> NDArray[np.float64]:
    """Vertices (rows, columns, 3) as (x, y, z) in tile widths, x = u, y = a·v, from the period's first
    vertex to the first vertex of the next period, plus `apron` = (rows, columns) cells on each side."""
    rows, columns = grid.z.shape
    j = np.arange(-apron[0], rows + 1 + apron[0])
    i = np.arange(-apron[1], columns + 1 + apron[1])
    x = (i + 0.5) / columns
    y = grid.aspect * (1.0 - (j + 0.5) / rows)
    z = grid.z[np.ix_(j % rows, i % columns)]
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None], z), axis=-1)


def grid_faces(rows: int, columns: int) -> NDArray[np.uint32]:
    """Triangles (2·(rows-1)·(columns-1), 3) of a grid of vertices, counter-clockwise seen from above."""
    index = np.arange(rows * columns, dtype=np.uint32).reshape(rows, columns)
    top_left, top_right = index[:-1, :-1], index[:-1, 1:]
    low_left, low_right = index[1:, :-1], index[1:, 1:]
    first = np.stack([top_left, low_left, low_right], axis=-1)
    second = np.stack([top_left, low_right, top_right], axis=-1)
    return np.stack([first, second], axis=2).reshape(-1, 3)


# Smallest z, a slope of 20, that 8-bit maps resolve.
_SMALLEST_Z = 0.05


def height_slopes(grid: HeightGrid) -> NDArray[np.float64]:
    """Slopes (H, W, 2) of the mesh at its vertices, by central differences over the period."""
    return mesh_slopes(grid.z, grid.aspect)


def normal_slopes(normal: NDArray[np.floating[Any]], smallest_z: float = _SMALLEST_Z) -> NDArray[np.float64]:
    """Slopes (h, w, 2) of unit normals (h, w, 3) with y along v, z clamped to at least `smallest_z`."""
    n = normal.astype(np.float64)
    return -n[..., :2] / np.maximum(n[..., 2:], smallest_z)


def residual_slopes(
    normal: NDArray[np.float32], grid: HeightGrid, mode: NormalMode = "residual"
) -> tuple[NDArray[np.float64], float]:
    """Slopes (h, w, 2) to add to the mesh's own at the texels of a map, and the share c ≥ 0 of the mesh's
    slopes that the map repeats, by least squares.

    Parameters
    ----------
    normal : (h, w, 3), unit vectors, y along v
    mode : ``residual``: slopes of the map less ``min(c, 1)`` times those of the mesh, so that slopes of both
        count once and displacement beyond the map's stays. ``absolute``: the map's slopes in place of the
        mesh's.
    """
    rows, columns = normal.shape[:2]
    stated = normal_slopes(normal)
    carried = np.asarray(resample(height_slopes(grid), rows, columns), np.float64)
    # Heights need not tile: the cliff at a seam is no slope that the map could repeat.
    edge = [-(-2 * size // have) for size, have in zip((rows, columns), grid.z.shape, strict=True)]
    if min(rows - 2 * edge[0], columns - 2 * edge[1]) < 1:
        edge = [0, 0]
    inner = (slice(edge[0], rows - edge[0]), slice(edge[1], columns - edge[1]))
    power = float(np.sum(carried[inner] ** 2))
    share = max(0.0, float(np.sum(carried[inner] * stated[inner])) / power) if power > 0 else 0.0
    taken = 1.0 if mode == "absolute" else min(share, 1.0)
    return stated - taken * carried, share


def triangle_slopes(grid: HeightGrid) -> NDArray[np.float64]:
    """Slopes |∇z| of all triangles of the periodic mesh (2·H·W,); all cover the same part of the plane."""
    rows, columns = grid.z.shape
    z = grid.z
    right, low = np.roll(z, -1, 1), np.roll(z, -1, 0)
    low_right = np.roll(low, -1, 1)
    per_x, per_y = float(columns), rows / grid.aspect
    first = np.hypot((low_right - low) * per_x, (z - low) * per_y)
    second = np.hypot((right - z) * per_x, (right - low_right) * per_y)
    return np.concatenate([first.ravel(), second.ravel()])


def slope_angles(grid: HeightGrid) -> tuple[float, float, float]:
    """Median, 99th percentile and maximum of the triangles' slopes, degrees."""
    slopes = triangle_slopes(grid)
    median, high = np.percentile(slopes, (50, 99))
    return tuple(float(np.degrees(np.arctan(s))) for s in (median, high, slopes.max()))  # type: ignore[return-value]


def rms_slope(grid: HeightGrid) -> float:
    """Root mean square of the triangles' slopes."""
    rows, columns = grid.z.shape
    # Every edge along an axis belongs to one triangle of either kind.
    along_u = np.mean((np.roll(grid.z, -1, 1) - grid.z) ** 2) * columns**2
    along_v = np.mean((np.roll(grid.z, -1, 0) - grid.z) ** 2) * (rows / grid.aspect) ** 2
    return float(np.sqrt(along_u + along_v))

"""The periodic height field as kernels read it: exact cells, bounding planes of blocks, and hits on it.

The nodes form a table whose rows have four numbers (c, a, b, w). At (x, y), in cells from the corner of a
cell or block, its height is ``c + a·x + b·y + w·max(0, x+y-1)``. For a cell this is the surface: two
triangles that meet at ``x + y = 1``. For a block of 2^L × 2^L cells w is zero, and the plane is nowhere below
the surface. On slopes it is a tighter bound than the block's maximum.

The cells come first, in row order. Block (i, j) of level L from 1 to ``finest`` is row
``cells + 2^(columns_log2 + rows_log2 - 2L) + j·2^(columns_log2 - L) + i``. The ranges of the levels are
disjoint, because each has a quarter of the blocks of the one below.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mbtf_gen.geometry.heightfield import HeightGrid
from mbtf_gen.render.types import Float, Int32, Mask, Normal3f, Point3f, Ray3f, SurfaceInteraction3f, Vector3f

# Ray offset relative to the largest coordinate: a few units in the last place of float32. An offset four
# times as large made points on a tile of aspect 64 too bright by 0.1 %.
_RELATIVE_OFFSET = 5.0e-7
# Numbers held in memory at once while the blocks of a level are computed.
_PASS_NUMBERS = 1 << 23
# Margin of the planes, relative to the displacement range: the rounding of single precision.
_MARGIN = 4e-7


@dataclass(frozen=True)
class HeightField:
    """A periodic height field in the form that kernels read.

    Lengths are in scene units; the origin is the tile's center. Numbers are opaque arrays of width 1, so that
    all tiles share the compiled kernels.

    Attributes
    ----------
    nodes : rows of the table. If `two_sided`, a second table follows, whose planes bound the surface from
        below
    columns, rows, cells : size of the grid; `cells` is their product
    columns_log2, both_log2, finest : logarithm of the columns, rounded up; sum of those of columns and rows;
        the smaller of them
    below : row at which the second table starts
    low : (x, y) of the first vertex
    cell, size : (x, y) lengths of a cell and of the tile
    bottom, top : z of the lowest and of the highest vertex
    offset : distance from the surface at which scattered rays start
    two_sided : whether rays may be below the surface
    powers : whether columns and rows are powers of two, which makes a step 15 % cheaper
    """

    nodes: Float
    columns: Int32
    rows: Int32
    cells: Int32
    columns_log2: Int32
    both_log2: Int32
    finest: Int32
    below: Int32
    low: tuple[Float, Float]
    cell: tuple[Float, Float]
    size: tuple[Float, Float]
    bottom: Float
    top: Float
    offset: Float
    two_sided: bool
    powers: bool

    @classmethod
    def of(cls, grid: HeightGrid, unit: float, two_sided: bool) -> HeightField:
        """Height field of a grid; `unit` is the number of scene units per tile width. Rays may be below the
        surface if it is `two_sided`, as behind an opacity mask."""
        # Row 0 of a map is the side y → max.
        z = grid.z[::-1] * unit
        rows, columns = z.shape
        columns_log2, rows_log2 = _logarithms(z)
        tables = [node_table(z, below) for below in (False, True)[: 1 + two_sided]]
        size = (unit, unit * grid.aspect)
        cell = (size[0] / columns, size[1] / rows)
        extent = max(0.5 * size[0], 0.5 * size[1], grid.displacement_range * unit)

        number, count = partial(dr.opaque, mi.Float), partial(dr.opaque, mi.Int32)
        # A copy: NumPy's memory need not have the alignment that reads of whole rows require.
        nodes = mi.Float(np.concatenate(tables).ravel()) + number(0.0)
        dr.eval(nodes)
        return cls(
            nodes,
            count(columns),
            count(rows),
            count(rows * columns),
            count(columns_log2),
            count(columns_log2 + rows_log2),
            count(min(columns_log2, rows_log2)),
            count(len(tables[0])),
            (number(0.5 * (cell[0] - size[0])), number(0.5 * (cell[1] - size[1]))),
            (number(cell[0]), number(cell[1])),
            (number(size[0]), number(size[1])),
            number(float(z.min())),
            number(float(z.max())),
            number(_RELATIVE_OFFSET * extent),
            two_sided,
            1 << columns_log2 == columns and 1 << rows_log2 == rows,
        )

    def leave(self, si: SurfaceInteraction3f, d: Vector3f) -> Ray3f:
        """Ray that starts at a surface point, offset along the normal, in direction d.

        The tile is centered on the origin, so hit points are exact to a few units in the last place.
        Mitsuba's own offset, 5e-5 tile widths, would pass through thin ridges and out of creases.
        """
        side = dr.select(dr.dot(si.n, d) < 0, -self.offset, self.offset)
        return mi.Ray3f(dr.fma(si.n, side, si.p), d)

    def interaction(self, p: Point3f, n: Normal3f, d: Vector3f, valid: Mask) -> SurfaceInteraction3f:
        """Surface interaction as Mitsuba's BSDFs and textures expect it, of rays in direction d.

        Parameters
        ----------
        p, n : Point3f, Normal3f
            Position in scene units from the tile's center, and unit normal with z > 0.
        valid : Mask
            Lanes with a hit. They get t = 0, the others t = ∞; distances are not needed.
        """
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
        si.t = dr.select(valid, mi.Float(0.0), dr.inf)
        si.p = p
        si.n = n
        # Mitsuba's bitmaps have row 0 at v = 0, ours at v → 1.
        si.uv = mi.Point2f(p.x / self.size[0] + 0.5, 0.5 - p.y / self.size[1])
        si.dp_du = self.size[0] * mi.Vector3f(1.0, 0.0, -n.x / n.z)
        si.dp_dv = -self.size[1] * mi.Vector3f(0.0, 1.0, -n.y / n.z)
        s = dr.normalize(si.dp_du)
        si.sh_frame = mi.Frame3f(s, dr.cross(n, s), n)
        si.wi = si.to_local(-d)
        return si


def _logarithms(z: NDArray[np.float64]) -> tuple[int, int]:
    """Logarithms to base 2 of the numbers of columns and rows, rounded up."""
    return (z.shape[1] - 1).bit_length(), (z.shape[0] - 1).bit_length()


def node_table(z: NDArray[np.float64], below: bool = False) -> NDArray[np.float32]:
    """Nodes (n, 4) of a periodic grid of heights (rows, columns), row index along +y. The planes bound the
    surface from above, or from `below`."""
    columns_log2, rows_log2 = _logarithms(z)
    finest = min(columns_log2, rows_log2)
    cells = z.size
    blocks = 1 << (columns_log2 + rows_log2 - 1) if finest else 0
    rows = np.zeros((cells + blocks, 4), np.float32)
    right, up = np.roll(z, -1, 1), np.roll(z, -1, 0)
    twist = np.roll(right, -1, 0) - right - up + z
    rows[:cells] = np.stack([z, right - z, up - z, twist], -1).reshape(-1, 4)
    sign = -1.0 if below else 1.0
    margin = _MARGIN * float(np.ptp(z))
    for level in range(1, finest + 1):
        first = cells + (1 << (columns_log2 + rows_log2 - 2 * level))
        stride = 1 << (columns_log2 - level)
        for j, planes in _planes(sign * z, level):
            planes[..., 0] += margin
            start = first + j * stride
            block = rows[start : start + len(planes) * stride].reshape(len(planes), stride, 4)
            block[:, : planes.shape[1], :3] = sign * planes
    return rows


def _planes(z: NDArray[np.float64], level: int) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """(first row, planes (rows, columns, 3) of the blocks) of a level, part by part."""
    height, width = z.shape
    side = 1 << level
    x, wide = _vertices(width, side)
    down = -(-height // side)
    part = max(1, _PASS_NUMBERS // ((side + 1) * x.size))
    for j in range(0, down, part):
        y, tall = _vertices(height, side, j, min(j + part, down))
        columns = (x + np.arange(len(x))[:, None] * side) % width
        lines = (y + np.arange(j, j + len(y))[:, None] * side) % height
        h = z[lines[:, None, :, None], columns[None, :, None, :]]
        a = (h[..., -1].mean(-1) - h[..., 0].mean(-1)) / wide
        b = (h[..., -1, :].mean(-1) - h[..., 0, :].mean(-1)) / tall[:, None]
        level_top = h.max((2, 3))
        h -= a[..., None, None] * x[None, :, None, :]
        h -= b[..., None, None] * y[:, None, :, None]
        sloped = h.max((2, 3))
        # The plane that is lower at the block's center.
        better = sloped + 0.5 * (a * wide + b * tall[:, None]) < level_top
        level_plane = np.stack([level_top, np.zeros_like(a), np.zeros_like(a)], -1)
        yield j, np.where(better[..., None], np.stack([sloped, a, b], -1), level_plane)


def _vertices(
    cells: int, side: int, start: int = 0, stop: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Positions (blocks, side + 1) of the blocks' vertices along one axis from the block's corner, and the
    blocks' lengths. The last block ends with the period; its last vertex is repeated."""
    blocks = np.arange(start, -(-cells // side) if stop is None else stop)
    length = np.minimum(side, cells - blocks * side)
    return np.minimum(np.arange(side + 1), length[:, None]), length

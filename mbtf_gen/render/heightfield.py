"""The periodic height field as kernels read it, and the offset of rays that leave it."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mbtf_gen.geometry.heightfield import HeightGrid
from mbtf_gen.render.heightfield_nodes import node_table
from mbtf_gen.render.types import Float, Int32, Ray3f, SurfaceInteraction3f, Vector3f

# Ray offset relative to the largest coordinate: a few units in the last place of float32. An offset four
# times as large made points on a tile of aspect 64 too bright by 0.1 %.
_RELATIVE_OFFSET = 5.0e-7


@dataclass(frozen=True)
class HeightField:
    """A periodic height field in the form that kernels read.

    Lengths are in scene units; the origin is the tile's center. Numbers are opaque arrays of width 1, so that
    all tiles share the compiled kernels.

    Attributes
    ----------
    nodes : Float
        Rows of :class:`~mbtf_gen.render.heightfield_nodes.NodeTable`. If `two_sided`, a second table follows,
        whose planes bound the surface from below.
    columns, rows, cells : Int32
        Size of the grid; `cells` is their product.
    columns_log2, both_log2, finest : Int32
        Offsets of the table's levels, see :class:`~mbtf_gen.render.heightfield_nodes.NodeTable`; `both_log2`
        is columns_log2 + rows_log2.
    below : Int32
        Row at which the second table starts.
    low : tuple of two Float
        (x, y) of the first vertex.
    cell, size : tuple of two Float
        (x, y) lengths of a cell and of the tile.
    bottom, top : Float
        z of the lowest and of the highest vertex.
    offset : Float
        Distance from the surface at which scattered rays start.
    two_sided : bool
        Whether rays may be below the surface.
    powers : bool
        Whether columns and rows are powers of two, which makes a step 15 % cheaper.
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
        """Height field of a grid.

        Parameters
        ----------
        grid : HeightGrid
            Heights in tile widths.
        unit : float
            Scene units per tile width.
        two_sided : bool
            Whether rays may be below the surface, as behind an opacity mask.
        """
        # Row 0 of a map is the side y → max.
        z = grid.z[::-1] * unit
        rows, columns = z.shape
        table = node_table(z)
        numbers = [table.rows, node_table(z, below=True).rows] if two_sided else [table.rows]

        def number(x: float) -> Float:
            return dr.opaque(mi.Float, x)

        def count(n: int) -> Int32:
            return dr.opaque(mi.Int32, n)

        # A copy: NumPy's memory need not have the alignment that reads of whole rows require.
        nodes = mi.Float(np.concatenate(numbers).ravel()) + number(0.0)
        dr.eval(nodes)
        cell = (unit / columns, unit * grid.aspect / rows)
        low = (0.5 * (cell[0] - unit), 0.5 * (cell[1] - unit * grid.aspect))
        extent = max(0.5 * unit, 0.5 * unit * grid.aspect, grid.displacement_range * unit)
        return cls(
            nodes,
            count(columns),
            count(rows),
            count(rows * columns),
            count(table.columns_log2),
            count(table.columns_log2 + table.rows_log2),
            count(table.finest),
            count(len(table.rows)),
            (number(low[0]), number(low[1])),
            (number(cell[0]), number(cell[1])),
            (number(unit), number(unit * grid.aspect)),
            number(float(z.min())),
            number(float(z.max())),
            number(_RELATIVE_OFFSET * extent),
            two_sided,
            1 << table.columns_log2 == columns and 1 << table.rows_log2 == rows,
        )

    def leave(self, si: SurfaceInteraction3f, d: Vector3f) -> Ray3f:
        """Ray that starts at a surface point, offset along the normal, in direction d.

        The tile is centered on the origin, so hit points are exact to a few units in the last place.
        Mitsuba's own offset, 5e-5 tile widths, would pass through thin ridges and out of creases.
        """
        side = dr.select(dr.dot(si.n, d) < 0, -self.offset, self.offset)
        return mi.Ray3f(dr.fma(si.n, side, si.p), d)

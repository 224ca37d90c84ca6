"""The periodic height field as kernels read it: exact cells, bounding planes of blocks
(:mod:`~mbtf_core.height_planes`), and hits on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Self

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mbtf_core.height_planes import logarithms, node_table
from mbtf_gen.engine.types import (
    Float,
    Int32,
    Mask,
    Normal3f,
    Point3f,
    Ray3f,
    SurfaceInteraction3f,
    Vector3f,
    padded,
)
from mbtf_gen.tile.tracers.protocol import Vertex

# Ray offset relative to the largest coordinate: a few units in the last place of float32. An offset four
# times as large made points on a tile of aspect 64 too bright by 0.1%.
_RELATIVE_OFFSET = 5.0e-7


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
    powers : whether columns and rows are powers of two, which makes a step 15% cheaper
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
    def of(cls, heights: NDArray[np.float64], aspect: float, unit: float, two_sided: bool) -> Self:
        """Height field of heights (H, W) ≤ 0 in tile widths, row 0 at ``v → 1``; `aspect` is H/W of the tile,
        and `unit` the number of scene units per tile width. Rays may be below the surface if it is
        `two_sided`, as behind an opacity mask."""
        # Row 0 of a map is the side y → max.
        z = heights[::-1] * unit
        rows, columns = z.shape
        columns_log2, rows_log2 = logarithms(z)
        tables = [node_table(z, below) for below in (False, True)[: 1 + two_sided]]
        size = (unit, unit * aspect)
        cell = (size[0] / columns, size[1] / rows)
        extent = max(0.5 * size[0], 0.5 * size[1], float(heights.max() - heights.min()) * unit)

        number, count = partial(dr.opaque, mi.Float), partial(dr.opaque, mi.Int32)
        # A copy: NumPy's memory need not have the alignment that reads of whole rows require.
        nodes = mi.Float(padded(np.concatenate(tables).ravel())) + number(0.0)
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

    def vertex(self, si: SurfaceInteraction3f) -> Vertex:
        return Vertex(mi.Point3f(si.p), mi.Normal3f(si.n))

    def interaction(self, vertex: Vertex, d: Vector3f, valid: Mask) -> SurfaceInteraction3f:
        return surface_interaction(vertex.p, vertex.n, d, valid, self.size)


def surface_interaction(
    p: Point3f, n: Normal3f, d: Vector3f, valid: Mask, size: tuple[Float, Float]
) -> SurfaceInteraction3f:
    """Surface interaction of a height field as Mitsuba's BSDFs and textures expect it.

    Parameters
    ----------
    p, n : position in scene units from the tile's center, and unit normal with z > 0
    d : directions of the rays
    valid : lanes with a hit. They get t = 0, the others t = ∞; distances are not needed.
    size : lengths of the tile along x and y
    """
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
    si.t = dr.select(valid, mi.Float(0.0), dr.inf)
    si.p = p
    si.n = n
    # Mitsuba's bitmaps have row 0 at v = 0, ours at v → 1.
    si.uv = mi.Point2f(p.x / size[0] + 0.5, 0.5 - p.y / size[1])
    si.dp_du = size[0] * mi.Vector3f(1.0, 0.0, -n.x / n.z)
    si.dp_dv = -size[1] * mi.Vector3f(0.0, 1.0, -n.y / n.z)
    s = dr.normalize(si.dp_du)
    si.sh_frame = mi.Frame3f(s, dr.cross(n, s), n)
    si.wi = si.to_local(-d)
    return si

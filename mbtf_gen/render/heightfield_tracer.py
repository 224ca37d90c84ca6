"""Rays on the displaced tile, repeated without end: where they first meet it.

The tile is a height field over a grid of cells, each of two triangles. A ray walks over the cells' blocks,
coarse where it runs above the planes that bound them (:mod:`~mbtf_gen.render.heightfield_nodes`), fine where it does not:
at a block that it may meet it goes down one level, past a block it goes on, one level up where it leaves the
block's parent as well (Tevs, Ihrke and Seidel 2008, with planes in place of maxima). Cells are counted modulo
the period, so the tile repeats at no cost.

No ray slips through: it stands above the surface at its start, and in each cell that it passes only the
heights above the surface where it crosses the diagonal and where it leaves are looked at. The first that is
not positive is a hit; whatever rounding moved it by, it is found there or in the next cell.

Positions are cells plus fractions of a cell, so that a place on a tile of any resolution is as exact as
single precision can hold it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mbtf_gen.geometry.heightfield import HeightGrid
from mbtf_gen.render.heightfield_nodes import node_table
from mbtf_gen.render.surface_interaction import interaction

# Directions are kept from being exactly parallel to an axis by this much per unit, lest 0/0 arise.
_TINY = 1e-18
# Levels at which rays begin: those from above the relief, and those that leave a surface.
_START_ABOVE, _START_WITHIN = 4, 0
# Ray offset over the largest coordinate: a few units in the last place of single precision. Four times as
# much made points on a tile 64 times as long as wide a thousandth too bright.
_RELATIVE_OFFSET = 5.0e-7


@dataclass(frozen=True)
class HeightField:
    """A periodic height field, ready for rays; lengths in scene units, centered on the tile. Numbers are of
    width 1 and kept out of the kernels' code, so that other tiles use the same compiled kernels.

    Attributes
    ----------
    nodes : rows of :class:`~mbtf_gen.render.heightfield_nodes.NodeTable`; where rays may be below the surface, followed by
        the table of planes below it
    columns, rows, cells, columns_log2, both_log2, finest, below : where rows of the table stand; `below` is
        the number of the second table's first row, 0 where there is none
    low : (x, y) of the first vertex; cell, size : (x, y) lengths of a cell and of the
        tile
    bottom, top : z of the lowest and of the highest vertex
    offset : distance from the surface at which a ray that leaves it starts
    two_sided : rays may be below the surface
    powers : columns and rows are powers of two, which makes a step a seventh shorter
    """

    nodes: Any
    columns: Any
    rows: Any
    cells: Any
    columns_log2: Any
    both_log2: Any
    finest: Any
    below: Any
    low: tuple[Any, Any]
    cell: tuple[Any, Any]
    size: tuple[Any, Any]
    bottom: Any
    top: Any
    offset: Any
    two_sided: bool
    powers: bool

    @classmethod
    def of(cls, grid: HeightGrid, unit: float, two_sided: bool) -> HeightField:
        """Field of a height grid, `unit` scene units per tile width."""
        # Row 0 of a map is the side y → max.
        z = grid.z[::-1] * unit
        rows, columns = z.shape
        table = node_table(z)
        numbers = [table.rows, node_table(z, below=True).rows] if two_sided else [table.rows]

        def number(x: float) -> Any:
            return dr.opaque(mi.Float, x)

        def count(n: int) -> Any:
            return dr.opaque(mi.Int32, n)

        # A copy: memory borrowed from NumPy is not aligned as reads of whole rows need it.
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

    def leave(self, si: Any, d: Any) -> Any:
        """Ray that leaves a surface point in direction d.

        The tile is centered on the origin, so hit points are exact to a few units in the last place and a far
        smaller offset than the renderer's own is enough: it would lift rays by 5e-5 tile widths, through thin
        ridges and out of creases.
        """
        side = dr.select(dr.dot(si.n, d) < 0, -self.offset, self.offset)
        return mi.Ray3f(dr.fma(si.n, side, si.p), d)


@dataclass
class TraversalState:
    """Where lanes' rays are.

    Attributes
    ----------
    column, row, x, y : cell, and place in it from 0 to 1
    z : height, in scene units
    level : of the block that is looked at next
    searching : lanes that go on
    hit : lanes that meet the surface within their cell
    crossings : borders of the tile crossed so far
    capped : lanes that reached the cap on crossings
    """

    column: Any
    row: Any
    x: Any
    y: Any
    z: Any
    level: Any
    searching: Any
    hit: Any
    crossings: Any
    capped: Any


@dataclass(frozen=True)
class RayConstants:
    """What stays the same along lanes' rays: direction in cells per scene unit, its signs and inverses.

    Attributes
    ----------
    x, y, z : direction; both : x + y, across the cells' diagonals
    over_x, over_y, over_both : inverses; the last negated
    right, up, rising : signs
    side : -1 where the ray is below the surface, else 1; a Python number where none may be
    """

    x: Any
    y: Any
    z: Any
    both: Any
    over_x: Any
    over_y: Any
    over_both: Any
    right: Any
    up: Any
    rising: Any
    side: Any


def _inverse(x: Any) -> Any:
    return dr.rcp(dr.select(x >= 0, dr.maximum(x, _TINY), dr.minimum(x, -_TINY)))


def _start(field: HeightField, ray: Any, active: Any, below: Any) -> tuple[TraversalState, RayConstants]:
    dx, dy, dz = ray.d.x / field.cell[0], ray.d.y / field.cell[1], ray.d.z
    column, x = _cell(ray.o.x, field.low[0], field.cell[0], field.columns)
    row, y = _cell(ray.o.y, field.low[1], field.cell[1], field.rows)
    both = dx + dy
    slant = RayConstants(
        dx, dy, dz, both,
        _inverse(dx), _inverse(dy), -_inverse(both),
        dx >= 0, dy >= 0, dz >= 0,
        dr.select(below, mi.Float(-1.0), 1.0) if field.two_sided else 1.0,
    )  # fmt: skip
    level = dr.select(ray.o.z >= field.top, mi.Int32(_START_ABOVE), _START_WITHIN)
    level = dr.minimum(level, field.finest)
    walk = TraversalState(
        column, row, x, y, mi.Float(ray.o.z), level,
        mi.Bool(active), mi.Bool(False), mi.UInt32(0), mi.Bool(False),
    )  # fmt: skip
    return walk, slant


def _cell(position: Any, low: Any, length: Any, cells: Any) -> tuple[Any, Any]:
    """(cell, place in it) of a coordinate, modulo the period. Numbers that are not finite end in some cell,
    too: nothing is read from outside the table."""
    p = (position - low) / length
    count = mi.Float(cells)
    p -= dr.floor(p / count) * count
    cell = dr.clip(mi.Int32(p), 0, cells - 1)
    return cell, p - mi.Float(cell)


def _above(z: Any, x: Any, y: Any, slant: RayConstants, node: Any) -> tuple[Any, Any]:
    """(height above a node's plane, or below it on the lower side; what is won per scene unit of the way)."""
    here = z - dr.fma(x, node.y, dr.fma(y, node.z, node.x))
    slope = dr.fma(-slant.x, node.y, dr.fma(-slant.y, node.z, slant.z))
    return slant.side * here, slant.side * slope


def _step(
    field: HeightField, walk: TraversalState, slant: RayConstants, max_crossings: Any
) -> TraversalState:
    """Look at one block: go past it, or down to the next level, or end.

    Rays that have met the surface stay where they are; those that have ended otherwise may go on, but nothing
    comes of it.
    """
    # The block, and the ray's place in it.
    size = mi.Int32(1) << walk.level
    i, j = walk.column & (size - 1), walk.row & (size - 1)
    left, low = walk.column - i, walk.row - j
    x, y = mi.Float(i) + walk.x, mi.Float(j) + walk.y
    leaf = walk.level == 0
    first = (mi.Int32(1) << (field.both_log2 - 2 * walk.level)) + field.cells
    index = (walk.row >> walk.level << (field.columns_log2 - walk.level)) + (walk.column >> walk.level)
    if field.powers:
        width = height = size
        index += dr.select(leaf, 0, first)
    else:
        width, height = dr.minimum(size, field.columns - left), dr.minimum(size, field.rows - low)
        index = dr.select(leaf, walk.row * field.columns + walk.column, index + first)
    if field.two_sided:
        index += dr.select(slant.side < 0, field.below, 0)
    node = dr.gather(mi.Vector4f, field.nodes, index)

    # Where the ray leaves it, and how far above the surface it is here, there, and at a cell's diagonal.
    to_x = (dr.select(slant.right, mi.Float(width), 0.0) - x) * slant.over_x
    to_y = (dr.select(slant.up, mi.Float(height), 0.0) - y) * slant.over_y
    end = dr.maximum(dr.minimum(to_x, to_y), 0.0)
    here, slope = _above(walk.z, x, y, slant, node)
    across = x + y - 1.0
    fold = slant.side * (dr.maximum(dr.fma(end, slant.both, across), 0.0) * node.w)
    diagonal = across * slant.over_both
    under = (diagonal > 0) & (diagonal < end) & (dr.fma(diagonal, slope, here) <= 0)
    # Written so that NaN counts as a hit: it must reach the value, where it is found and drawn again.
    free = (dr.fma(end, slope, here) - fold > 0) & (leaf | (here > 0)) & ~under
    walk.hit |= walk.searching & leaf & ~free

    # Past the block, into the next cell.
    end = dr.select(free, end, 0.0)
    x, y = dr.fma(end, slant.x, x), dr.fma(end, slant.y, y)
    walk.z = dr.fma(end, slant.z, walk.z)
    along_x = free & (to_x <= to_y)
    along_y = free & ~along_x
    i = dr.select(along_x, dr.select(slant.right, width, -1), dr.clip(mi.Int32(x), 0, width - 1))
    j = dr.select(along_y, dr.select(slant.up, height, -1), dr.clip(mi.Int32(y), 0, height - 1))
    walk.x = dr.select(along_x, dr.select(slant.right, 0.0, 1.0), x - mi.Float(i))
    walk.y = dr.select(along_y, dr.select(slant.up, 0.0, 1.0), y - mi.Float(j))
    i, j = left + i, low + j
    leaves_parent = ((i ^ walk.column) | (j ^ walk.row)) >> (walk.level + 1) != 0
    above = dr.select(leaves_parent, dr.minimum(walk.level + 1, field.finest), walk.level)
    walk.level = dr.select(free, above, dr.maximum(walk.level - 1, 0))

    # Modulo the period.
    if field.powers:
        walk.column, walk.row = i & (field.columns - 1), j & (field.rows - 1)
    else:
        walk.column = dr.select(i < 0, field.columns - 1, dr.select(i >= field.columns, 0, i))
        walk.row = dr.select(j < 0, field.rows - 1, dr.select(j >= field.rows, 0, j))
    gone = slant.rising & (walk.z >= field.top)
    if field.two_sided:
        gone = (gone & (slant.side > 0)) | (~slant.rising & (walk.z <= field.bottom) & (slant.side < 0))
    walk.searching &= ~walk.hit & ~gone
    crossed = walk.searching & ((walk.column != i) | (walk.row != j))
    walk.capped |= crossed & (walk.crossings >= max_crossings)
    walk.crossings += dr.select(crossed & ~walk.capped, mi.UInt32(1), 0)
    walk.searching &= ~walk.capped
    return walk


def _surface(field: HeightField, walk: TraversalState, slant: RayConstants, d: Any) -> Any:
    """Surface interactions of lanes that meet the surface within their cell."""
    index = walk.row * field.columns + walk.column
    node = dr.gather(mi.Vector4f, field.nodes, index)
    here, slope = _above(walk.z, walk.x, walk.y, slant, node)
    to_x = (dr.select(slant.right, 1.0, 0.0) - walk.x) * slant.over_x
    to_y = (dr.select(slant.up, 1.0, 0.0) - walk.y) * slant.over_y
    end = dr.maximum(dr.minimum(to_x, to_y), 0.0)
    across = walk.x + walk.y - 1.0
    diagonal = across * slant.over_both
    # The triangle in which the ray enters the cell, or the other one.
    second = (across > 0) | ((across == 0) & (slant.both > 0))
    passes = (diagonal > 0) & (diagonal < end) & (dr.fma(diagonal, slope, here) > 0)
    second ^= passes
    fold = dr.select(second, node.w, 0.0)
    bend = slant.side * fold
    t = dr.clip((here - across * bend) / (slant.both * bend - slope), 0.0, end)
    x, y = mi.Float(walk.column) + dr.fma(t, slant.x, walk.x), mi.Float(walk.row) + dr.fma(t, slant.y, walk.y)
    p = mi.Point3f(
        dr.fma(x, field.cell[0], field.low[0]),
        dr.fma(y, field.cell[1], field.low[1]),
        dr.fma(t, slant.z, walk.z),
    )
    n = dr.normalize(mi.Normal3f(-(node.y + fold) / field.cell[0], -(node.z + fold) / field.cell[1], 1.0))
    return interaction(p, n, d, field.size, walk.hit)


@dr.syntax
def _follow(
    field: HeightField, walk: TraversalState, slant: RayConstants, max_crossings: int
) -> TraversalState:
    """Follow rays until they meet the surface, leave it behind, or reach the cap."""
    while dr.hint(walk.searching, exclude=[field, slant]):
        walk = _step(field, walk, slant, max_crossings)
    return walk


@dr.syntax
def _follow_two(
    field: HeightField,
    one: TraversalState,
    slant_one: RayConstants,
    two: TraversalState,
    slant_two: RayConstants,
    max_crossings: int,
) -> tuple[TraversalState, TraversalState]:
    """:func:`_follow` for two rays of each lane at a time. A step of one ray is a chain of instructions that
    wait for each other; those of two rays fill each other's gaps."""
    while dr.hint(one.searching | two.searching, exclude=[field, slant_one, slant_two]):
        one = _step(field, one, slant_one, max_crossings)
        two = _step(field, two, slant_two, max_crossings)
    return one, two


@dr.syntax
def _search(
    field: HeightField, ray: Any, active: Any, max_crossings: int, below: Any, holes: Any, rng: Any
) -> tuple[TraversalState, RayConstants, Any]:
    """Follow rays until something stops them for good."""
    walk, slant = _start(field, ray, active, below)
    if dr.hint(holes is None, mode="scalar"):
        walk = _follow(field, walk, slant, max_crossings)
    else:
        ray, below, searching = mi.Ray3f(ray), mi.Bool(below), mi.Bool(active)
        while dr.hint(searching, exclude=[field, holes, slant]):
            piece, way = _start(field, ray, searching, below)
            piece.crossings = walk.crossings
            walk = _follow(field, piece, way, max_crossings)
            si = _surface(field, walk, way, ray.d)
            searching = walk.hit & (rng.chance() >= holes.opacity(si))
            walk.hit &= ~searching
            ray.o = dr.select(searching, field.leave(si, ray.d).o, ray.o)
            below ^= searching
        slant = _start(field, ray, active, below)[1]
    return walk, slant, rng


def closest_hit(
    field: HeightField,
    ray: Any,
    active: Any,
    max_crossings: int,
    below: Any = False,
    holes: Any = None,
    rng: Any = None,
) -> tuple[Any, Any, Any, Any]:
    """First hit along a ray over the repeated tile.

    Parameters
    ----------
    max_crossings : borders of the tile that a ray may cross
    below : rays that start below the surface, which a field that is not two-sided knows none of
    holes : ``holes.opacity(si)``, the chance that a hit stops the ray; None where nothing lets rays through
    rng : random numbers that decide it

    Returns
    -------
    (surface interaction, in the tile; crossings spent; lanes that hit the cap; the generator)
    """
    walk, slant, rng = _search(field, ray, active, max_crossings, below, holes, rng)
    return _surface(field, walk, slant, ray.d), walk.crossings, walk.capped, rng


def occluded(
    field: HeightField,
    ray: Any,
    active: Any,
    max_crossings: int,
    below: Any = False,
    holes: Any = None,
    rng: Any = None,
) -> tuple[Any, Any, Any, Any]:
    """Whether a ray meets anything over the repeated tile; parameters as of :func:`closest_hit`.

    Returns
    -------
    (occluded; crossings spent; lanes that hit the cap, which count as occluded; the generator)
    """
    walk, _, rng = _search(field, ray, active, max_crossings, below, holes, rng)
    return walk.hit | walk.capped, walk.crossings, walk.capped, rng


def hit_and_shadow(
    field: HeightField,
    ray: Any,
    active: Any,
    shadow_ray: Any,
    shadow_active: Any,
    max_crossings: int,
    below: Any = False,
    shadow_below: Any = False,
) -> tuple[Any, Any, Any, Any]:
    """:func:`closest_hit` of a ray and :func:`occluded` of another at once, where there are no holes.

    Returns
    -------
    (surface interaction; lanes whose ray hit the cap; occluded; lanes whose other ray hit the cap)
    """
    walk, slant = _start(field, ray, active, below)
    shadow, shadow_slant = _start(field, shadow_ray, shadow_active, shadow_below)
    walk, shadow = _follow_two(field, walk, slant, shadow, shadow_slant, max_crossings)
    hit = _surface(field, walk, slant, ray.d)
    return hit, walk.capped, shadow.hit | shadow.capped, shadow.capped

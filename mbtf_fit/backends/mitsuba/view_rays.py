"""Rays from above a plane, traced to a periodic height field.

The quadtree of :mod:`mbtf_gen.tile.tracers.heightfield_tracer`, for rays from above on grids whose sides are
powers of two. The state of a ray is its distance and the level of the next block: a third fewer instructions
per block. A block is looked up slightly ahead of the ray, by more than the rounding of its position, so that
each step proceeds. Rays that are longer than :data:`LONGEST`, which are rare, and those of other grids are
traced as in data sets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mbtf_gen.engine.types import Float, Int32, Mask, Ray3f
from mbtf_gen.tile.tracers.heightfield import HeightField
from mbtf_gen.tile.tracers.heightfield_tracer import (
    RayConstants,
    TraversalState,
    closest_height,
    start_traversal,
    surface_within_cell,
)

# Tile lengths along each axis that rays are traced.
LONGEST = 2
# Distance along each axis that the ray's block is ahead of it, as a share of the tile.
_AHEAD = 2.0**-20
# Levels of the first block below that of the displacement range.
_FINER = 2


@dataclass
class _State:
    """A ray: its distance, the level of the next block, whether to go on, whether it hits within its cell."""

    t: Float
    level: Int32
    searching: Mask
    hit: Mask


@dataclass(frozen=True)
class _Axis:
    """One axis of a ray, in cells: it is at ``cell + fraction + t rate``, at least 0. `over` is 1/rate."""

    cell: Int32
    fraction: Float
    rate: Float
    over: Float
    cells: Int32

    @property
    def longest(self) -> Float:
        """Distance at which it ends."""
        return LONGEST * dr.abs(mi.Float(self.cells) * self.over)

    def block(self, t: Float, level: Int32) -> tuple[Int32, Float, Int32, Float]:
        """The ray's block; its position there; number of the border that it approaches; distance there."""
        start, forward = mi.Float(self.cell) + self.fraction, self.rate >= 0.0
        ahead = _AHEAD * mi.Float(self.cells)
        p = dr.fma(t, self.rate, start + dr.select(forward, ahead, -ahead))
        block = mi.Int32(p) >> level
        border = block + dr.select(forward, mi.Int32(1), 0)
        end = (mi.Float(border << level) - start) * self.over
        return block, p - mi.Float(block << level), border, end

    def wrapped(self, block: Int32, level: Int32) -> Int32:
        """Number of a block in the tile."""
        return block & (self.cells - 1 >> level)

    def within_cell(self, t: Float) -> tuple[Int32, Float]:
        """The ray's cell in the tile, and its position there, as exact as where it starts."""
        cell = self.block(t, mi.Int32(0))[0]
        return self.wrapped(cell, 0), dr.fma(t, self.rate, mi.Float(self.cell - cell) + self.fraction)


@dataclass(frozen=True)
class _Line:
    """What does not change along a ray."""

    start: TraversalState
    constants: RayConstants
    x: _Axis
    y: _Axis

    @classmethod
    def of(cls, field: HeightField, ray: Ray3f, active: Mask) -> _Line:
        start, c = start_traversal(field, ray, mi.Bool(active), mi.Bool(False))
        x = _Axis(start.column + LONGEST * field.columns, start.x, c.x, c.over_x, field.columns)
        y = _Axis(start.row + LONGEST * field.rows, start.y, c.y, c.over_y, field.rows)
        return cls(start, c, x, y)

    def height(self, field: HeightField, ray: Ray3f, t: Float) -> Float:
        """Height of the intersection within the cell at a distance."""
        (column, x), (row, y) = self.x.within_cell(t), self.y.within_cell(t)
        cell = replace(self.start, column=column, row=row, x=x, y=y, z=t * self.constants.z)
        return surface_within_cell(field, cell, self.constants, ray.d).p.z


def heights_below(
    field: HeightField, rays: Sequence[Ray3f], crossings: int, active: Mask = True
) -> list[Float]:
    """Heights of the first intersections of rays, as :func:`closest_height` finds them.

    Parameters
    ----------
    field : one-sided, in tile widths
    rays : from the plane z = 0 downwards, traced together, as the instructions of a ray wait for each other
    crossings : borders of the tile that rays may cross
    active : lanes to trace
    """
    if not field.powers:
        return [closest_height(field, ray, crossings, active) for ray in rays]
    depth = dr.maximum(-field.bottom / field.cell[0], 1.0)
    level = dr.clip(mi.Int32(dr.log2(depth)) - _FINER, 0, field.finest)
    lines = [_Line.of(field, ray, active) for ray in rays]
    states = [_State(mi.Float(0.0), mi.Int32(level), mi.Bool(active), mi.Bool(False)) for _ in rays]
    states = _follow(field, lines, states)
    return [
        dr.if_stmt(
            (ray, state.hit, line.height(field, ray, state.t)),
            active & ~state.hit,
            lambda ray, hit, z: closest_height(field, ray, crossings, active & ~hit),
            lambda ray, hit, z: z,
        )
        for ray, line, state in zip(rays, lines, states, strict=True)
    ]


@dr.syntax
def _follow(field: HeightField, lines: Sequence[_Line], states: list[_State]) -> list[_State]:
    """Trace rays to the cells that they hit."""
    while dr.hint(dr.any([state.searching for state in states], axis=0), exclude=[field, lines]):
        states = [_step(field, *ray) for ray in zip(lines, states, strict=True)]
    return states


def _step(field: HeightField, line: _Line, state: _State) -> _State:
    """Test one block: skip it, descend one level, or end."""
    t, level, c = state.t, state.level, line.constants
    (column, x, right, to_x), (row, y, top, to_y) = (a.block(t, level) for a in (line.x, line.y))
    leaf, along_x = level == 0, to_x <= to_y
    index = line.x.wrapped(column, level) + (line.y.wrapped(row, level) << (field.columns_log2 - level))
    first = (mi.Int32(1) << (field.both_log2 - 2 * level)) + field.cells
    node = dr.gather(mi.Vector4f, field.nodes, index + dr.select(leaf, 0, first))
    end = dr.select(along_x, to_x, to_y)
    length = end - t
    # Heights above the block's plane here, at its border, and at the diagonal of a cell.
    here = dr.fma(t, c.z, -dr.fma(x, node.y, dr.fma(y, node.z, node.x)))
    slope = dr.fma(-c.x, node.y, dr.fma(-c.y, node.z, c.z))
    across = x + y - 1.0
    beyond, diagonal = dr.fma(length, c.both, across), across * c.over_both
    there = dr.fma(length, slope, here) - dr.select(beyond > 0.0, beyond, 0.0) * node.w
    under = (diagonal > 0.0) & (diagonal < length) & (dr.fma(diagonal, slope, here) <= 0.0)
    free = (there > 0.0) & (leaf | (here > 0.0)) & ~under
    state.hit |= state.searching & leaf & ~free
    # The border is one of the parent too if its number is even.
    up = dr.minimum(level + 1 - (dr.select(along_x, right, top) & 1), field.finest)
    state.level = dr.select(free, up, dr.maximum(level - 1, 0))
    state.t = dr.select(free & state.searching, end, t)
    state.searching &= ~state.hit & (state.t < dr.minimum(line.x.longest, line.y.longest))
    return state

"""View rays over a plane, traced to a periodic height field.

The quadtree of :mod:`mbtf_gen.tile.tracers.heightfield_tracer`, for rays from above on grids whose sides are
powers of two. The state of a ray is its distance and the level of the next block: a third fewer instructions
per block. A block is looked up slightly ahead of the ray, by more than the rounding of its position, so that
each step proceeds. Rays that are longer than :data:`LONGEST`, which are rare, and those of other grids are
traced as in data sets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mbtf_gen.engine.types import Float, Int32, Mask, Ray3f
from mbtf_gen.tile.tracers.heightfield import HeightField
from mbtf_gen.tile.tracers.heightfield_tracer import (
    RayConstants,
    closest_height,
    start_traversal,
    surface_within_cell,
)

# Tile lengths along each axis that rays are traced.
LONGEST = 2
# Distance along each axis that the ray's block is ahead of it, as a share of the tile.
_AHEAD = 2.0**-21
# Levels of the first block below that of the displacement range.
_FINER = 2


@dataclass(frozen=True)
class _Axis:
    """One axis of a ray, in cells: it is at ``start + t rate``, at least 0; `ahead` takes the place of the
    start in lookups. `over` is 1/rate, `forward` 1 or 0, `mask` the number of cells less one."""

    start: Float
    ahead: Float
    rate: Float
    over: Float
    forward: Int32
    mask: Int32

    @classmethod
    def of(cls, cell: Int32, fraction: Float, rate: Float, over: Float, cells: Int32) -> _Axis:
        start = mi.Float(cell + LONGEST * cells) + fraction
        ahead, forward = _AHEAD * mi.Float(cells), rate >= 0.0
        ahead = start + dr.select(forward, ahead, -ahead)
        return cls(start, ahead, rate, over, dr.select(forward, mi.Int32(1), 0), cells - 1)


@dataclass(frozen=True)
class _Step:
    """A block that a ray is in: its number along the axis, the ray's position in it, the number of the border
    that the ray approaches, and the distance at which it is there."""

    block: Int32
    x: Float
    border: Int32
    end: Float

    @classmethod
    def of(cls, axis: _Axis, t: Float, level: Int32) -> _Step:
        p = dr.fma(t, axis.rate, axis.ahead)
        block = mi.Int32(p) >> level
        border = block + axis.forward
        end = (mi.Float(border << level) - axis.start) * axis.over
        return cls(block & (axis.mask >> level), p - mi.Float(block << level), border, end)


@dataclass
class _State:
    """State of a ray: its distance, the level of the next block, whether it is traced further, and whether it
    hits the surface within the cell."""

    t: Float
    level: Int32
    searching: Mask
    hit: Mask


def heights_below(
    heightfield: HeightField, rays: Sequence[Ray3f], max_crossings: int, active: Mask = True
) -> list[Float]:
    """Heights of the first intersections of rays, as :func:`closest_height` finds them.

    Parameters
    ----------
    heightfield : one-sided, in tile widths
    rays : from the plane z = 0 downwards; they are traced together, as the instructions of a ray wait for
        each other
    max_crossings : borders of the tile that rays may cross
    active : lanes to trace
    """
    if not heightfield.powers:
        return [closest_height(heightfield, ray, max_crossings, active) for ray in rays]
    depth = dr.maximum(-heightfield.bottom / heightfield.cell[0], 1.0)
    level = dr.clip(mi.Int32(dr.log2(depth)) - _FINER, 0, heightfield.finest)
    starts = [start_traversal(heightfield, ray, mi.Bool(active), mi.Bool(False)) for ray in rays]
    axes = [
        (
            _Axis.of(cell.column, cell.x, constants.x, constants.over_x, heightfield.columns),
            _Axis.of(cell.row, cell.y, constants.y, constants.over_y, heightfield.rows),
        )
        for cell, constants in starts
    ]
    constants = [c for _, c in starts]
    states = [_State(mi.Float(0.0), mi.Int32(level), mi.Bool(active), mi.Bool(False)) for _ in rays]
    states = _follow(heightfield, axes, constants, states)
    found = []
    for ray, (cell, own), axis, state in zip(rays, starts, axes, states, strict=True):
        across, along = (_Step.of(a, state.t, mi.Int32(0)) for a in axis)
        cell.column, cell.x, cell.row, cell.y = across.block, across.x, along.block, along.x
        cell.z = state.t * own.z
        z = surface_within_cell(heightfield, cell, own, ray.d).p.z
        found.append(
            dr.if_stmt(
                (ray, state.hit, z),
                active & ~state.hit,
                lambda ray, hit, z: closest_height(heightfield, ray, max_crossings, active & ~hit),
                lambda ray, hit, z: z,
            )
        )
    return found


@dr.syntax
def _follow(
    heightfield: HeightField,
    axes: Sequence[tuple[_Axis, _Axis]],
    constants: Sequence[RayConstants],
    states: list[_State],
) -> list[_State]:
    """Trace rays to the cells that they hit."""
    while dr.hint(
        dr.any([state.searching for state in states], axis=0), exclude=[heightfield, axes, constants]
    ):
        states = [_step(heightfield, *ray) for ray in zip(axes, constants, states, strict=True)]
    return states


def _step(
    heightfield: HeightField, axes: tuple[_Axis, _Axis], constants: RayConstants, state: _State
) -> _State:
    """Test one block: skip it, descend one level, or end."""
    t, level = state.t, state.level
    across, along = (_Step.of(axis, t, level) for axis in axes)
    leaf = level == 0
    index = (along.block << (heightfield.columns_log2 - level)) + across.block
    first = (mi.Int32(1) << (heightfield.both_log2 - 2 * level)) + heightfield.cells
    node = dr.gather(mi.Vector4f, heightfield.nodes, index + dr.select(leaf, 0, first))
    turns = across.end <= along.end
    end = dr.select(turns, across.end, along.end)
    length = end - t
    # Heights above the block's plane here, at its border, and at the diagonal of a cell.
    here = dr.fma(t, constants.z, -dr.fma(across.x, node.y, dr.fma(along.x, node.z, node.x)))
    slope = dr.fma(-constants.x, node.y, dr.fma(-constants.y, node.z, constants.z))
    over = across.x + along.x - 1.0
    beyond = dr.fma(length, constants.both, over)
    there = dr.fma(length, slope, here) - dr.select(beyond > 0.0, beyond, 0.0) * node.w
    diagonal = over * constants.over_both
    under = (diagonal > 0.0) & (diagonal < length) & (dr.fma(diagonal, slope, here) <= 0.0)
    free = (there > 0.0) & (leaf | (here > 0.0)) & ~under
    state.hit |= state.searching & leaf & ~free
    # The border is one of the parent too if its number is even.
    border = dr.select(turns, across.border, along.border)
    up = dr.minimum(level + 1 - (border & 1), heightfield.finest)
    state.level = dr.select(free, up, dr.maximum(level - 1, 0))
    state.t = dr.select(free & state.searching, end, t)
    longest = [dr.abs(mi.Float(axis.mask + 1) * axis.over) for axis in axes]
    state.searching &= ~state.hit & (state.t < LONGEST * dr.minimum(*longest))
    return state

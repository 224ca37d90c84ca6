"""Intersection of rays with the periodic height field of the displaced tile.

The surface is a grid of cells, each of two triangles. A ray traverses a quadtree of blocks of cells. Each
block stores a plane that bounds its surface from above (:mod:`~mbtf_gen.tile.tracers.heightfield`). If the
ray may intersect a block, traversal descends one level. Otherwise it skips the block, and ascends one level
where the ray leaves the parent as well (Tevs, Ihrke and Seidel 2008, "Maximum mipmaps for fast, accurate,
and scalable dynamic height field rendering", with planes in place of maxima). Cell indices wrap at the
period, so the tile repeats at no cost.

The test of a cell is watertight. A ray starts above the surface. In each cell its height above the surface
is evaluated at two points: where it crosses the diagonal and where it leaves the cell. The first height that
is not positive is a hit. Rounding can only move a hit into the next cell.

A position is the index of a cell plus a fraction, so that its precision does not depend on the resolution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_gen.engine.types import Float, Int32, Mask, Ray3f, SurfaceInteraction3f, UInt32, Vector3f, Vector4f
from mbtf_gen.sampling.sobol import SobolSampler
from mbtf_gen.tile.tracers.heightfield import HeightField
from mbtf_gen.tile.tracers.protocol import Vertex

# Smallest magnitude of a direction's component, which avoids 0/0 for rays parallel to an axis.
_TINY = 1e-18
# Levels at which traversal starts: of rays from above the surface, and of rays that leave the surface.
_START_ABOVE, _START_WITHIN = 4, 0


@dataclass
class TraversalState:
    """State of the traversal, one ray per lane.

    Attributes
    ----------
    column, row, x, y : index of the cell, and position in it from 0 to 1
    z : height, in scene units
    level : level of the block that is tested next
    searching : lanes whose traversal continues
    hit : lanes whose ray intersects the surface within the cell
    crossings : tile borders crossed so far
    capped : lanes that reached the cap on crossings
    """

    column: Int32
    row: Int32
    x: Float
    y: Float
    z: Float
    level: Int32
    searching: Mask
    hit: Mask
    crossings: UInt32
    capped: Mask


@dataclass(frozen=True)
class RayConstants:
    """Constants of a ray: its direction in cells per scene unit, with signs and inverses.

    Attributes
    ----------
    x, y, z : direction; both : x + y, the rate across the cells' diagonals
    over_x, over_y, over_both : inverses; the last one negated
    right, up, rising : signs
    side : -1 where the ray is below the surface, else 1; a Python number for one-sided height fields
    """

    x: Float
    y: Float
    z: Float
    both: Float
    over_x: Float
    over_y: Float
    over_both: Float
    right: Mask
    up: Mask
    rising: Mask
    side: Float


def _inverse(x: Float) -> Float:
    return dr.rcp(dr.select(x >= 0, dr.maximum(x, _TINY), dr.minimum(x, -_TINY)))


def start_traversal(
    heightfield: HeightField, ray: Ray3f, active: Mask, below: Mask
) -> tuple[TraversalState, RayConstants]:
    dx, dy, dz = ray.d.x / heightfield.cell[0], ray.d.y / heightfield.cell[1], ray.d.z
    column, x = _cell(ray.o.x, heightfield.low[0], heightfield.cell[0], heightfield.columns)
    row, y = _cell(ray.o.y, heightfield.low[1], heightfield.cell[1], heightfield.rows)
    both = dx + dy
    constants = RayConstants(
        dx, dy, dz, both,
        _inverse(dx), _inverse(dy), -_inverse(both),
        dx >= 0, dy >= 0, dz >= 0,
        dr.select(below, mi.Float(-1.0), 1.0) if heightfield.two_sided else 1.0,
    )  # fmt: skip
    level = dr.select(ray.o.z >= heightfield.top, mi.Int32(_START_ABOVE), _START_WITHIN)
    level = dr.minimum(level, heightfield.finest)
    state = TraversalState(
        column, row, x, y, mi.Float(ray.o.z), level,
        mi.Bool(active), mi.Bool(False), mi.UInt32(0), mi.Bool(False),
    )  # fmt: skip
    return state, constants


def _cell(position: Float, low: Float, length: Float, cells: Int32) -> tuple[Int32, Float]:
    """(cell, position in it) of a coordinate, modulo the period. Non-finite coordinates are clamped to a
    cell as well, so that no lane reads outside the table."""
    p = (position - low) / length
    count = mi.Float(cells)
    p -= dr.floor(p / count) * count
    cell = dr.clip(mi.Int32(p), 0, cells - 1)
    return cell, p - mi.Float(cell)


def _above(z: Float, x: Float, y: Float, constants: RayConstants, node: Vector4f) -> tuple[Float, Float]:
    """(signed height of a ray above a node's plane; its derivative along the ray). The sign is flipped for
    rays below the surface."""
    here = z - dr.fma(x, node.y, dr.fma(y, node.z, node.x))
    slope = dr.fma(-constants.x, node.y, dr.fma(-constants.y, node.z, constants.z))
    return constants.side * here, constants.side * slope


@dataclass(frozen=True)
class Block:
    """The block of cells that a ray is in, and the ray's way to its border.

    Attributes
    ----------
    left, low : first column and row; width, height : numbers of cells
    x, y : position in the block, in cells
    leaf : whether the block is a single cell
    node : its row of the table
    to_x, to_y : distances to the borders that the ray approaches
    """

    left: Int32
    low: Int32
    width: Int32
    height: Int32
    x: Float
    y: Float
    leaf: Mask
    node: Vector4f
    to_x: Float
    to_y: Float

    @classmethod
    def of(cls, heightfield: HeightField, state: TraversalState, constants: RayConstants) -> Block:
        """The block of the state's level."""
        size = mi.Int32(1) << state.level
        i, j = state.column & (size - 1), state.row & (size - 1)
        left, low = state.column - i, state.row - j
        x, y = mi.Float(i) + state.x, mi.Float(j) + state.y
        leaf = state.level == 0
        first = (mi.Int32(1) << (heightfield.both_log2 - 2 * state.level)) + heightfield.cells
        index = state.row >> state.level << (heightfield.columns_log2 - state.level)
        index += state.column >> state.level
        if heightfield.powers:
            width = height = size
            index += dr.select(leaf, 0, first)
        else:
            width = dr.minimum(size, heightfield.columns - left)
            height = dr.minimum(size, heightfield.rows - low)
            index = dr.select(leaf, state.row * heightfield.columns + state.column, index + first)
        if heightfield.two_sided:
            index += dr.select(constants.side < 0, heightfield.below, 0)
        node = dr.gather(mi.Vector4f, heightfield.nodes, index)
        to_x = (dr.select(constants.right, mi.Float(width), 0.0) - x) * constants.over_x
        to_y = (dr.select(constants.up, mi.Float(height), 0.0) - y) * constants.over_y
        return cls(left, low, width, height, x, y, leaf, node, to_x, to_y)

    def leave(
        self, heightfield: HeightField, state: TraversalState, constants: RayConstants, end: Float, free: Mask
    ) -> tuple[Int32, Int32]:
        """Move the state by `end`, into the next block where lanes are `free`, else one level down; returns
        its cell before it wraps at the period, which the state does not have yet."""
        x, y = dr.fma(end, constants.x, self.x), dr.fma(end, constants.y, self.y)
        along_x = free & (self.to_x <= self.to_y)
        along_y = free & ~along_x
        i = dr.select(
            along_x, dr.select(constants.right, self.width, -1), dr.clip(mi.Int32(x), 0, self.width - 1)
        )
        j = dr.select(
            along_y, dr.select(constants.up, self.height, -1), dr.clip(mi.Int32(y), 0, self.height - 1)
        )
        state.x = dr.select(along_x, dr.select(constants.right, 0.0, 1.0), x - mi.Float(i))
        state.y = dr.select(along_y, dr.select(constants.up, 0.0, 1.0), y - mi.Float(j))
        i, j = self.left + i, self.low + j
        leaves_parent = ((i ^ state.column) | (j ^ state.row)) >> (state.level + 1) != 0
        above = dr.select(leaves_parent, dr.minimum(state.level + 1, heightfield.finest), state.level)
        state.level = dr.select(free, above, dr.maximum(state.level - 1, 0))
        # Modulo the period.
        if heightfield.powers:
            state.column, state.row = i & (heightfield.columns - 1), j & (heightfield.rows - 1)
        else:
            state.column = dr.select(
                i < 0, heightfield.columns - 1, dr.select(i >= heightfield.columns, 0, i)
            )
            state.row = dr.select(j < 0, heightfield.rows - 1, dr.select(j >= heightfield.rows, 0, j))
        return i, j


def _step(
    heightfield: HeightField, state: TraversalState, constants: RayConstants, max_crossings: UInt32
) -> TraversalState:
    """Test one block: skip it, descend one level, or end.

    Rays that hit the surface stay in their cell. Rays that ended otherwise may be stepped further, without
    effect on the result.
    """
    block = Block.of(heightfield, state, constants)
    # The height above the surface here, at the block's border and at a cell's diagonal.
    end = dr.maximum(dr.minimum(block.to_x, block.to_y), 0.0)
    here, slope = _above(state.z, block.x, block.y, constants, block.node)
    across = block.x + block.y - 1.0
    fold = constants.side * (dr.maximum(dr.fma(end, constants.both, across), 0.0) * block.node.w)
    diagonal = across * constants.over_both
    under = (diagonal > 0) & (diagonal < end) & (dr.fma(diagonal, slope, here) <= 0)
    # NaN counts as a hit: it must reach the value, where the sample is detected and drawn again.
    free = (dr.fma(end, slope, here) - fold > 0) & (block.leaf | (here > 0)) & ~under
    state.hit |= state.searching & block.leaf & ~free

    # Skip the block, into the next cell.
    end = dr.select(free, end, 0.0)
    state.z = dr.fma(end, constants.z, state.z)
    i, j = block.leave(heightfield, state, constants, end, free)
    gone = constants.rising & (state.z >= heightfield.top)
    if heightfield.two_sided:
        below = ~constants.rising & (state.z <= heightfield.bottom)
        gone = (gone & (constants.side > 0)) | (below & (constants.side < 0))
    state.searching &= ~state.hit & ~gone
    crossed = state.searching & ((state.column != i) | (state.row != j))
    state.capped |= crossed & (state.crossings >= max_crossings)
    state.crossings += dr.select(crossed & ~state.capped, mi.UInt32(1), 0)
    state.searching &= ~state.capped
    return state


def surface_within_cell(
    heightfield: HeightField, state: TraversalState, constants: RayConstants, d: Vector3f
) -> SurfaceInteraction3f:
    """Surface interactions of lanes whose ray hits the surface within the cell."""
    index = state.row * heightfield.columns + state.column
    node = dr.gather(mi.Vector4f, heightfield.nodes, index)
    here, slope = _above(state.z, state.x, state.y, constants, node)
    to_x = (dr.select(constants.right, 1.0, 0.0) - state.x) * constants.over_x
    to_y = (dr.select(constants.up, 1.0, 0.0) - state.y) * constants.over_y
    end = dr.maximum(dr.minimum(to_x, to_y), 0.0)
    across = state.x + state.y - 1.0
    diagonal = across * constants.over_both
    # The triangle that contains the hit: the one in which the ray enters the cell, or the other one.
    second = (across > 0) | ((across == 0) & (constants.both > 0))
    passes = (diagonal > 0) & (diagonal < end) & (dr.fma(diagonal, slope, here) > 0)
    second ^= passes
    fold = dr.select(second, node.w, 0.0)
    bend = constants.side * fold
    t = dr.clip((here - across * bend) / (constants.both * bend - slope), 0.0, end)
    x = mi.Float(state.column) + dr.fma(t, constants.x, state.x)
    y = mi.Float(state.row) + dr.fma(t, constants.y, state.y)
    p = mi.Point3f(
        dr.fma(x, heightfield.cell[0], heightfield.low[0]),
        dr.fma(y, heightfield.cell[1], heightfield.low[1]),
        dr.fma(t, constants.z, state.z),
    )
    dz_dx, dz_dy = (node.y + fold) / heightfield.cell[0], (node.z + fold) / heightfield.cell[1]
    n = dr.normalize(mi.Normal3f(-dz_dx, -dz_dy, 1.0))
    return heightfield.interaction(Vertex(p, n), d, state.hit)


@dr.syntax
def _follow(
    heightfield: HeightField, state: TraversalState, constants: RayConstants, max_crossings: int
) -> TraversalState:
    """Traverse until rays hit the surface, leave its slab, or reach the cap."""
    while dr.hint(state.searching, exclude=[heightfield, constants]):
        state = _step(heightfield, state, constants, max_crossings)
    return state


@dr.syntax
def _follow_two(
    heightfield: HeightField,
    one: TraversalState,
    constants_one: RayConstants,
    two: TraversalState,
    constants_two: RayConstants,
    max_crossings: int,
) -> tuple[TraversalState, TraversalState]:
    """:func:`_follow` for two rays of each lane at a time. The instructions of one step depend on each other;
    interleaving two rays hides their latency."""
    while dr.hint(one.searching | two.searching, exclude=[heightfield, constants_one, constants_two]):
        one = _step(heightfield, one, constants_one, max_crossings)
        two = _step(heightfield, two, constants_two, max_crossings)
    return one, two


@dr.syntax
def _search(
    heightfield: HeightField,
    ray: Ray3f,
    active: Mask,
    max_crossings: int,
    below: Mask,
    holes: Any,
    rng: Any,
) -> tuple[TraversalState, RayConstants, Any]:
    """Traverse until rays hit an opaque point; at each hit the opacity decides by chance whether it is."""
    state, constants = start_traversal(heightfield, ray, active, below)
    if dr.hint(holes is None, mode="scalar"):
        state = _follow(heightfield, state, constants, max_crossings)
    else:
        ray, below, searching = mi.Ray3f(ray), mi.Bool(below), mi.Bool(active)
        while dr.hint(searching, exclude=[heightfield, holes, constants]):
            segment, segment_constants = start_traversal(heightfield, ray, searching, below)
            segment.crossings = state.crossings
            state = _follow(heightfield, segment, segment_constants, max_crossings)
            si = surface_within_cell(heightfield, state, segment_constants, ray.d)
            searching = state.hit & (rng.chance() >= holes.opacity(si))
            state.hit &= ~searching
            ray.o = dr.select(searching, heightfield.leave(si, ray.d).o, ray.o)
            below ^= searching
        constants = start_traversal(heightfield, ray, active, below)[1]
    return state, constants, rng


class HeightfieldGeometry(HeightField):
    """A height field that paths are traced on, see :class:`~mbtf_gen.tile.tracers.protocol.TileGeometry`."""

    open = False

    def closest_hit(
        self,
        ray: Ray3f,
        active: Mask,
        max_crossings: int,
        below: Mask = False,
        holes: Any = None,
        rng: SobolSampler | None = None,
    ) -> tuple[SurfaceInteraction3f, UInt32, Mask, Any]:
        """First intersections of rays; only those with two-sided height fields may start below."""
        state, constants, rng = _search(self, ray, active, max_crossings, below, holes, rng)
        return surface_within_cell(self, state, constants, ray.d), state.crossings, state.capped, rng

    def occluded(
        self,
        ray: Ray3f,
        active: Mask,
        max_crossings: int,
        below: Mask = False,
        holes: Any = None,
        rng: SobolSampler | None = None,
    ) -> tuple[Mask, UInt32, Mask, Any]:
        state, _, rng = _search(self, ray, active, max_crossings, below, holes, rng)
        return state.hit | state.capped, state.crossings, state.capped, rng

    def hit_and_shadow(
        self,
        ray: Ray3f,
        active: Mask,
        shadow_ray: Ray3f,
        shadow_active: Mask,
        max_crossings: int,
        below: Mask = False,
        shadow_below: Mask = False,
    ) -> tuple[SurfaceInteraction3f, Mask, Mask, Mask]:
        """Both in one loop."""
        state, constants = start_traversal(self, ray, active, below)
        shadow, shadow_constants = start_traversal(self, shadow_ray, shadow_active, shadow_below)
        state, shadow = _follow_two(self, state, constants, shadow, shadow_constants, max_crossings)
        hit = surface_within_cell(self, state, constants, ray.d)
        return hit, state.capped, shadow.hit | shadow.capped, shadow.capped


def closest_height(heightfield: HeightField, ray: Ray3f, max_crossings: int, active: Mask = True) -> Float:
    """Heights in scene units of the first intersections of rays from above; of rays that would cross more
    than `max_crossings` borders of the tile, the height there."""
    state, constants = start_traversal(heightfield, ray, mi.Bool(active), mi.Bool(False))
    state = _follow(heightfield, state, constants, max_crossings)
    return dr.select(state.hit, surface_within_cell(heightfield, state, constants, ray.d).p.z, state.z)

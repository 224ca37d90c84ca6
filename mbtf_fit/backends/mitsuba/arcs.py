"""Rays in the shell of heights over a curved surface.

The surface is the top of the shell, z = 0. Over the tangent plane of a curved surface a straight ray is an
arc. With the normal curvature κ along the ray's azimuth, in 1/tile width and positive where the surface is
convex, a ray from a view with the cosine c and the sine q has, at the distance s along the surface,

    z = S w / (q - 2 w sin h),  w = q sin h - c cos h,  h = κ s/2,  S = 2 sin(h)/κ,

exact over spheres and across cylinders; to second order ``z = -s c/q + κ s²/2`` at grazing angles, the
parabola of Oliveira and Policarpo 2005, "An efficient representation for surface details". It ends at the
bottom of the shell, or leaves the shell without an intersection.

Traversal is that of :mod:`mbtf_gen.tile.tracers.heightfield_tracer`, with a chord of the arc in each block.
Over a concave surface the arc is above the chord. Over a convex one it is above the parabola of the largest
second derivative ``κ (1 + 2 z'²)``: with heights f, g of the chord's ends above a block's plane, it clears
the block if ``√f + √g > 2 √m``, where m is an eighth of that derivative times the chord's square.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mbtf_gen.engine.types import Float, Mask, Point3f, Vector2f, Vector3f
from mbtf_gen.tile.tracers.heightfield import HeightField
from mbtf_gen.tile.tracers.heightfield_tracer import (
    Block,
    RayConstants,
    TraversalState,
    start_traversal,
)

# Smallest sine of a view: a vertical ray has no azimuth.
_STEEPEST = 1e-3
# Smallest curvature of an arc, in 1/tile width.
_STRAIGHTEST = 1e-9


@dataclass(frozen=True)
class Arc:
    """View rays over a curved surface, lengths in tile widths.

    Attributes
    ----------
    azimuth : unit vectors of the tile along which the rays proceed
    cosine, sine : of the angle between the rays and the direction downwards
    curvature : normal curvature along the azimuth
    end : distance along the surface at which the rays end
    bend : an eighth of the largest second derivative of their height, at least 0
    cut : whether a ray ends at the longest distance that is traced
    """

    azimuth: Vector2f
    cosine: Float
    sine: Float
    curvature: Float
    end: Float
    bend: Float
    cut: Mask

    @classmethod
    def of(cls, d: Vector3f, curvature: Vector3f, depth: Float, longest: float) -> Arc:
        """Rays in unit directions d from the top of a shell of a depth over a surface of curvatures
        (xx, xy, yy), at most so many tile widths long."""
        flat = mi.Vector2f(d.x, d.y)
        length = dr.norm(flat)
        azimuth = dr.select(length > 0.0, flat / length, mi.Vector2f(-1.0, 0.0))
        curvature = dr.dot(tilt(curvature, azimuth), azimuth)
        curvature = dr.mulsign(dr.maximum(dr.abs(curvature), _STRAIGHTEST), curvature)
        sine = dr.maximum(length, _STEEPEST)
        cosine = dr.mulsign(dr.sqrt(dr.maximum(1.0 - sine * sine, 1e-12)), -d.z)
        # Up to the bottom, or else up to the top.
        drop = depth * (2.0 - curvature * depth)
        to_bottom = cosine * cosine - curvature * drop
        last = dr.select(
            to_bottom >= 0.0,
            drop / dr.maximum(cosine + dr.sqrt(dr.maximum(to_bottom, 0.0)), 1e-6),
            2.0 * cosine / dr.maximum(curvature, 1e-9),
        )
        last = dr.select(cosine > 0.0, last, 0.0)
        arc = cls(
            azimuth,
            cosine,
            sine,
            curvature,
            mi.Float(0.0),
            mi.Float(0.0),
            mi.Bool(False),
        )
        end = arc.position(last)
        cut = end > longest
        end = dr.minimum(end, longest)
        # Slopes are steepest at the ends.
        steepest = dr.maximum(dr.abs(cosine / sine), dr.abs(arc.slope(end)))
        bend = 0.125 * dr.maximum(curvature, 0.0) * dr.fma(2.0, dr.square(steepest), 1.0)
        return replace(arc, end=end, bend=bend, cut=cut)

    def position(self, t: Float) -> Float:
        """Distances along the surface at distances along the ray."""
        bent = self.curvature * t
        return dr.atan2(bent * self.sine, 1.0 - bent * self.cosine) / self.curvature

    def height(self, s: Float) -> Float:
        """Heights at distances along the surface."""
        h = 0.5 * self.curvature * s
        square = dr.square(h)
        # tan h = a h/b, by Padé.
        a, b = dr.fma(-2 / 21, square, 1.0), dr.fma(square, dr.fma(1 / 105, square, -3 / 7), 1.0)
        p, r = a * h, b * self.cosine / self.sine
        return a * s * (p - r) * dr.rcp(dr.fma(p, 2.0 * r - p, b * b))

    def slope(self, s: Float) -> Float:
        """Slopes of the ray, relative to the surface there, at distances along the surface."""
        sin, cos = dr.sincos(self.curvature * s)
        return (self.sine * sin - self.cosine * cos) / (self.sine * cos + self.cosine * sin)


def tilt(curvature: Vector3f, step: Vector2f) -> Vector2f:
    """Change of a normal's horizontal part over a step in the tangent plane, by curvatures (xx, xy, yy)."""
    return mi.Vector2f(
        curvature.x * step.x + curvature.y * step.y, curvature.y * step.x + curvature.z * step.y
    )


def on_top(u: Iterable[Float], aspect: float) -> Point3f:
    """Points of the top of the shell, by uv, as rays start there to be traced to the heights."""
    x, y = (c - dr.floor(c) for c in u)
    return mi.Point3f(x - 0.5, (y - 0.5) * aspect, 0.0)


@dataclass
class ArcState:
    """State of rays: the block's traversal, and the distance along the surface."""

    block: TraversalState
    s: Float


def trace_arcs(
    heightfield: HeightField, places: Iterable[Iterable[Float]], arc: Arc, aspect: float, active: Mask
) -> list[tuple[Mask, Float, Float]]:
    """First intersections of rays with the heights.

    Parameters
    ----------
    heightfield : of unit scale, in tile widths
    places : uv of points over which rays start, traced together
    arc : the rays
    aspect : height of the tile over its width
    active : lanes to trace

    Returns
    -------
    list of (Mask, Float, Float)
        Whether a ray meets the heights; the distance along the surface and the height at which.
    """
    along = mi.Vector3f(arc.azimuth.x, arc.azimuth.y, 0.0)
    starts = [
        start_traversal(heightfield, mi.Ray3f(on_top(u, aspect), along), mi.Bool(active), mi.Bool(False))
        for u in places
    ]
    constants = starts[0][1]
    states = [ArcState(block, mi.Float(0.0)) for block, _ in starts]
    states = _follow(heightfield, states, constants, arc)
    return [_meet(heightfield, state, constants, arc, active) for state in states]


@dr.syntax
def _follow(
    heightfield: HeightField, states: list[ArcState], constants: RayConstants, arc: Arc
) -> list[ArcState]:
    while dr.hint(
        dr.any([state.block.searching for state in states], axis=0), exclude=[heightfield, constants, arc]
    ):
        states = [_step(heightfield, state, constants, arc) for state in states]
    return states


@dataclass(frozen=True)
class _Chord:
    """The part of a ray within a block: the length `end` along the surface to the ray's `s` and `z`, and
    heights above the block's plane."""

    end: Float
    s: Float
    z: Float
    here: Float
    there: Float
    across: Float
    diagonal: Float
    at_diagonal: Float

    @classmethod
    def of(cls, block: Block, state: ArcState, constants: RayConstants, arc: Arc) -> _Chord:
        end = dr.maximum(dr.minimum(block.to_x, block.to_y), 0.0)
        s = dr.minimum(state.s + end, arc.end)
        end = dr.maximum(s - state.s, 0.0)
        z = arc.height(s)
        node, x, y = block.node, block.x, block.y
        here = state.block.z - dr.fma(x, node.y, dr.fma(y, node.z, node.x))
        x, y = dr.fma(end, constants.x, x), dr.fma(end, constants.y, y)
        there = z - dr.fma(x, node.y, dr.fma(y, node.z, node.x))
        across = block.x + block.y - 1.0
        diagonal = across * constants.over_both
        at = dr.fma(there - here, diagonal, here * end)
        return cls(end, s, z, here, there, across, diagonal, at)

    @property
    def crosses(self) -> Mask:
        """Whether it crosses the diagonal of a cell."""
        return (self.diagonal > 0) & (self.diagonal < self.end)


def _step(heightfield: HeightField, state: ArcState, constants: RayConstants, arc: Arc) -> ArcState:
    """Test one block: skip it, descend one level, or end."""
    block = Block.of(heightfield, state.block, constants)
    chord = _Chord.of(block, state, constants, arc)
    fold = dr.maximum(dr.fma(chord.end, constants.both, chord.across), 0.0) * block.node.w
    here, there = chord.here, chord.there - fold
    rest = here + there - 4.0 * arc.bend * dr.square(chord.end)
    clear = (here > 0) & ((rest > 0) | (rest * rest < 4.0 * here * there))
    free = (there > 0) & (block.leaf | clear) & ~(chord.crosses & (chord.at_diagonal <= 0))
    state.block.hit |= state.block.searching & block.leaf & ~free
    block.leave(heightfield, state.block, constants, dr.select(free, chord.end, 0.0), free)
    state.s, state.block.z = dr.select(free, chord.s, state.s), dr.select(free, chord.z, state.block.z)
    state.block.searching &= ~state.block.hit & ~(free & (state.s >= arc.end))
    return state


def _meet(
    heightfield: HeightField, state: ArcState, constants: RayConstants, arc: Arc, active: Mask
) -> tuple[Mask, Float, Float]:
    """The intersection within the cell of a state."""
    state.block.level = mi.Int32(0)
    block = Block.of(heightfield, state.block, constants)
    chord = _Chord.of(block, state, constants, arc)
    # The triangle that contains it: the one in which the ray enters the cell, or the other one.
    second = (chord.across > 0) | ((chord.across == 0) & (constants.both > 0))
    second ^= chord.crosses & (chord.at_diagonal > 0)
    fold = dr.select(second, block.node.w, 0.0)
    here = chord.here - fold * chord.across
    there = chord.there - fold * dr.fma(chord.end, constants.both, chord.across)
    share = dr.clip(here / (here - there), 0.0, 1.0)
    hit = active & (state.block.hit | arc.cut)
    share = dr.select(state.block.hit, share, 0.0)
    return hit, dr.fma(share, chord.end, state.s), dr.lerp(state.block.z, chord.z, share)

"""Rays in the shell of heights over a curved surface.

The surface is the top of the shell, z = 0. Over the tangent plane of a curved surface a straight ray is an
arc. With the normal curvature κ along the ray's azimuth, in 1/tile width and positive where the surface is
convex, it has at distance t, from a view with the cosine c and the sine q, the position and the height

    s = atan2(κ t q, 1 - κ t c) / κ,    z = t (κ t - 2 c) / (1 + √(1 + κ t (κ t - 2 c))),

exact over spheres and across cylinders; to second order ``z = -s c/q + κ s²/2`` at grazing angles, the
parabola of Oliveira and Policarpo 2005, "An efficient representation for surface details". It ends at the
bottom of the shell, or leaves the shell without an intersection.

Traversal is that of :mod:`mbtf_gen.tile.tracers.heightfield_tracer`, with a chord of the arc in each block.
A chord deviates from the arc by less than ``κ m (1 + |∇|) Δt²/8``, with the slope ∇ of the block's plane and
``m = (1 - κ D)⁻³`` at the depth D of the shell; blocks are skipped where the chord clears them by that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mbtf_gen.engine.types import Float, Mask, Point2f, Vector2f, Vector3f
from mbtf_gen.tile.tracers.heightfield import HeightField
from mbtf_gen.tile.tracers.heightfield_tracer import (
    Block,
    RayConstants,
    TraversalState,
    start_traversal,
)

# Smallest sine of a view: a vertical ray has no azimuth.
_STEEPEST = 1e-3


@dataclass(frozen=True)
class Arc:
    """View rays over a curved surface, lengths in tile widths.

    Attributes
    ----------
    azimuth : unit vectors of the tile along which the rays proceed
    cosine, sine : of the angle between the rays and the direction downwards
    curvature : normal curvature along the azimuth at the height where the rays start
    start, shrinkage : that height; lengths at the surface per length there
    end, last : distances along the surface, and along the ray, at which the rays end
    cut : whether a ray ends at the longest distance that is traced
    passes : whether it does not go as deep as the shell
    """

    azimuth: Vector2f
    cosine: Float
    sine: Float
    curvature: Float
    start: Float
    shrinkage: Float
    end: Float
    last: Float
    cut: Mask
    passes: Mask

    @classmethod
    def of(cls, d: Vector3f, curvature: Vector3f, depth: Float, longest: float, start: Float = 0.0) -> Arc:
        """Rays in unit directions d over a surface of curvatures (xx, xy, yy), through a shell of a depth,
        from a height in it, at most so many tile widths long."""
        flat = mi.Vector2f(d.x, d.y)
        length = dr.norm(flat)
        azimuth = dr.select(length > 0.0, flat / length, mi.Vector2f(-1.0, 0.0))
        curvature = dr.dot(tilt(curvature, azimuth), azimuth)
        shrinkage = dr.rcp(1.0 + curvature * start)
        curvature = curvature * shrinkage
        sine = dr.maximum(length, _STEEPEST)
        cosine = dr.mulsign(dr.sqrt(dr.maximum(1.0 - sine * sine, 1e-12)), -d.z)
        # Up to the bottom, or else up to the top.
        down, up = depth + start, dr.maximum(-start, 0.0)
        drop, rise = down * (2.0 - curvature * down), up * (2.0 + curvature * up)
        to_bottom, to_top = cosine * cosine - curvature * drop, cosine * cosine + curvature * rise
        root = dr.sqrt(dr.maximum(to_top, 0.0))
        last = dr.select(
            (cosine > 0.0) & (to_bottom >= 0.0) | (to_top < 0.0),
            drop / dr.maximum(cosine + dr.sqrt(dr.maximum(to_bottom, 0.0)), 1e-6),
            dr.select(
                cosine > 0.0,
                (cosine + root) / dr.maximum(curvature, 1e-9),
                rise / dr.maximum(root - cosine, 1e-6),
            ),
        )
        arc = cls(
            azimuth,
            cosine,
            sine,
            curvature,
            start,
            shrinkage,
            mi.Float(0.0),
            last,
            mi.Bool(False),
            to_bottom < 0.0,
        )
        end = arc.position(last)
        cut = end > longest
        end = dr.minimum(end, longest)
        return replace(arc, end=end, last=dr.select(cut, arc.distance(end), last), cut=cut)

    def position(self, t: Float) -> Float:
        """Distances along the surface at distances along the ray."""
        bent = self.curvature * t
        below = 1.0 - bent * self.cosine
        angle = dr.atan2(bent * self.sine, below)
        near = t * self.sine / dr.maximum(below, 1e-3) * (1.0 - angle * angle / 3.0)
        return self.shrinkage * dr.select(dr.abs(angle) < 1e-3, near, angle / self.curvature)

    def distance(self, s: Float) -> Float:
        """Inverse of :meth:`position`."""
        s = s / self.shrinkage
        angle = dr.clip(self.curvature * s, -3.0, 3.0)
        sin, cos = dr.sincos(angle)
        chord = s * dr.select(dr.abs(angle) < 1e-3, 1.0 - angle * angle / 6.0, sin / angle)
        return chord / (self.sine * cos + self.curvature * chord * self.cosine)

    def height(self, t: Float) -> Float:
        """Heights at distances along the ray."""
        bent = dr.fma(self.curvature, t, -2.0 * self.cosine)
        root = dr.sqrt(dr.maximum(dr.fma(self.curvature * t, bent, 1.0), 0.0))
        return self.start + t * bent / (1.0 + root)


def tilt(curvature: Vector3f, step: Vector2f) -> Vector2f:
    """Change of a normal's horizontal part over a step in the tangent plane, by curvatures (xx, xy, yy)."""
    return mi.Vector2f(
        curvature.x * step.x + curvature.y * step.y, curvature.y * step.x + curvature.z * step.y
    )


@dataclass
class ArcState:
    """State of rays: the block's traversal, and the distances along the surface and the ray."""

    block: TraversalState
    s: Float
    t: Float


def trace_arcs(
    heightfield: HeightField, u: Point2f, arc: Arc, aspect: float, active: Mask
) -> tuple[Mask, Float, Float]:
    """First intersections of rays with the heights.

    Parameters
    ----------
    heightfield : of unit scale, in tile widths
    u : points over which the rays start, uv
    arc : the rays
    aspect : height of the tile over its width
    active : lanes to trace

    Returns
    -------
    (Mask, Float, Float)
        Whether a ray meets the heights; the distance along the surface and the height at which.
    """
    x, y = (c - dr.floor(c) for c in u)
    ray = mi.Ray3f(
        mi.Point3f(x - 0.5, (y - 0.5) * aspect, arc.start), mi.Vector3f(arc.azimuth.x, arc.azimuth.y, 0.0)
    )
    block, constants = start_traversal(heightfield, ray, mi.Bool(active), mi.Bool(False))
    state = ArcState(block, mi.Float(0.0), mi.Float(0.0))
    # The largest factor by which curvature grows towards the bottom of the shell.
    depth = -heightfield.bottom
    growth = dr.rcp(1.0 - dr.maximum(arc.curvature, 0.0) * depth) ** 3
    state = _follow(heightfield, state, constants, arc, 0.125 * growth * dr.abs(arc.curvature))
    return _meet(heightfield, state, constants, arc, active)


@dr.syntax
def _follow(
    heightfield: HeightField, state: ArcState, constants: RayConstants, arc: Arc, sag: Float
) -> ArcState:
    while dr.hint(state.block.searching, exclude=[heightfield, constants, arc, sag]):
        state = _step(heightfield, state, constants, arc, sag)
    return state


@dataclass(frozen=True)
class _Chord:
    """The part of a ray within a block: the length `end` along the surface to the ray's `s` and `t`, and
    heights above the block's plane."""

    end: Float
    s: Float
    t: Float
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
        t = dr.select(s >= arc.end, arc.last, arc.distance(s))
        node, x, y = block.node, block.x, block.y
        here = state.block.z - dr.fma(x, node.y, dr.fma(y, node.z, node.x))
        x, y = dr.fma(end, constants.x, x), dr.fma(end, constants.y, y)
        there = arc.height(t) - dr.fma(x, node.y, dr.fma(y, node.z, node.x))
        across = block.x + block.y - 1.0
        diagonal = across * constants.over_both
        at = dr.lerp(here, there, diagonal / dr.maximum(end, 1e-12))
        return cls(end, s, t, here, there, across, diagonal, at)

    @property
    def crosses(self) -> Mask:
        """Whether it crosses the diagonal of a cell."""
        return (self.diagonal > 0) & (self.diagonal < self.end)


def _step(
    heightfield: HeightField, state: ArcState, constants: RayConstants, arc: Arc, sag: Float
) -> ArcState:
    """Test one block: skip it, descend one level, or end."""
    block = Block.of(heightfield, state.block, constants)
    chord = _Chord.of(block, state, constants, arc)
    fold = dr.maximum(dr.fma(chord.end, constants.both, chord.across), 0.0) * block.node.w
    steep = 1.0 + dr.abs(block.node.y) / heightfield.cell[0] + dr.abs(block.node.z) / heightfield.cell[1]
    margin = dr.select(block.leaf, 0.0, sag * steep * dr.square(chord.t - state.t))
    free = (chord.there - fold > margin) & (block.leaf | (chord.here > margin))
    free &= ~(chord.crosses & (chord.at_diagonal <= 0))
    state.block.hit |= state.block.searching & block.leaf & ~free
    block.leave(heightfield, state.block, constants, dr.select(free, chord.end, 0.0), free)
    state.s, state.t = dr.select(free, chord.s, state.s), dr.select(free, chord.t, state.t)
    state.block.z = arc.height(state.t)
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
    return hit, dr.fma(share, chord.end, state.s), dr.lerp(state.block.z, arc.height(chord.t), share)

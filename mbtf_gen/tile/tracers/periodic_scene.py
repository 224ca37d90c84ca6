"""Geometry of one period, traced by Mitsuba: Embree on the CPU, OptiX on CUDA.

A ray is traced within the box of one period at a time. Where it leaves the box through a side without a
hit, it enters again through the opposite one, so the tile repeats exactly, however low the ray. Segments
overlap by a few units in the last place, so that no ray slips through the seam.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_gen.engine.types import Float, Mask, Point3f, Ray3f, Scene, SurfaceInteraction3f, UInt32, Vector3f

# Overlap of segments relative to the largest coordinate.
OVERLAP = 1.0e-6
# Smallest magnitude of a direction's component, which avoids 0/0 for rays parallel to an axis.
_TINY = 1e-18


@dataclass
class Search:
    """State of rays on their way: where they enter the box, and what they hit.

    Attributes
    ----------
    o : origin within the box
    searching : lanes whose search continues
    hit : lanes with a hit
    at : the hit, as :meth:`PeriodicScene._located` describes it
    crossings, capped : tile borders crossed, lanes that reached the cap
    """

    o: Point3f
    searching: Mask
    hit: Mask
    at: Any
    crossings: UInt32
    capped: Mask


@dataclass(frozen=True)
class PeriodicScene(ABC):
    """Shapes that cover one period and its seams.

    The methods are those of :class:`~mbtf_gen.tile.tracers.protocol.TileGeometry`.

    Attributes
    ----------
    scene : the shapes, in scene units
    low, size : (x, y) of the box's first corner, and its lengths
    bottom, top : z of the lowest and of the highest point
    offset, overlap : distance from the surface at which scattered rays start; overlap of segments
    """

    scene: Scene
    low: tuple[Float, Float]
    size: tuple[Float, Float]
    bottom: Float
    top: Float
    offset: Float
    overlap: Float

    @abstractmethod
    def _located(self, found: Any, segment: Ray3f) -> Any:
        """What of a preliminary intersection is kept: an array, or a tuple of arrays."""

    @abstractmethod
    def _surface(self, at: Any, d: Vector3f, valid: Mask) -> SurfaceInteraction3f:
        """Surface interactions of rays in direction d, of what :meth:`_located` kept."""

    def closest_hit(
        self,
        ray: Ray3f,
        active: Mask,
        max_crossings: int,
        below: Mask = False,
        holes: Any = None,
        rng: Any = None,
    ) -> tuple[SurfaceInteraction3f, UInt32, Mask, Any]:
        state, rng = self._search(ray, active, max_crossings, holes, rng)
        return self._surface(state.at, ray.d, state.hit), state.crossings, state.capped, rng

    def occluded(
        self,
        ray: Ray3f,
        active: Mask,
        max_crossings: int,
        below: Mask = False,
        holes: Any = None,
        rng: Any = None,
    ) -> tuple[Mask, UInt32, Mask, Any]:
        state, rng = self._search(ray, active, max_crossings, holes, rng, any_hit=holes is None)
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
        """One after the other."""
        si, _, capped, _ = self.closest_hit(ray, active, max_crossings)
        blocked, _, shadow_capped, _ = self.occluded(shadow_ray, shadow_active, max_crossings)
        return si, capped, blocked, shadow_capped

    def leave(self, si: SurfaceInteraction3f, d: Vector3f) -> Ray3f:
        side = dr.select(dr.dot(si.n, d) < 0, -self.offset, self.offset)
        return mi.Ray3f(dr.fma(si.n, side, si.p), d)

    @dr.syntax
    def _search(
        self, ray: Ray3f, active: Mask, max_crossings: int, holes: Any, rng: Any, any_hit: bool = False
    ) -> tuple[Search, Any]:
        """Trace rays, box by box, until they hit an opaque point, leave the slab, or reach the cap."""
        d, low, size = ray.d, self.low, self.size
        high = (low[0] + size[0], low[1] + size[1])
        # Origins outside of the box are those of another period.
        o = mi.Point3f(_wrapped(ray.o.x, low[0], size[0]), _wrapped(ray.o.y, low[1], size[1]), ray.o.z)
        over_x, over_y = _inverse(d.x), _inverse(d.y)
        right, up, rising = d.x >= 0, d.y >= 0, d.z >= 0
        constants = (d, low, high, over_x, over_y, right, up, rising)
        # NaN counts as a hit: it must reach the value, where the sample is detected and drawn again.
        faulty = active & ~dr.isfinite(dr.sum(o) + dr.sum(d))
        nothing = dr.zeros(mi.PreliminaryIntersection3f, dr.width(d))
        nothing.prim_uv = dr.select(faulty, mi.Point2f(dr.nan), 0.0)
        at = self._located(nothing, mi.Ray3f(o, d))
        state = Search(o, active & ~faulty, mi.Bool(faulty), at, mi.UInt32(0), mi.Bool(False))
        back = mi.Float(0.0)
        while dr.hint(state.searching, exclude=[self, holes, constants]):
            to_x = (dr.select(right, high[0], low[0]) - state.o.x) * over_x
            to_y = (dr.select(up, high[1], low[1]) - state.o.y) * over_y
            end = dr.maximum(dr.minimum(to_x, to_y), 0.0)
            segment = mi.Ray3f(dr.fma(d, -back, state.o), d)
            segment.maxt = end + back + self.overlap
            if dr.hint(any_hit, mode="scalar"):
                hit = state.searching & self.scene.ray_test(segment, coherent=False, active=state.searching)
            else:
                found = self.scene.ray_intersect_preliminary(segment, coherent=False, active=state.searching)
                hit = state.searching & found.is_valid()
                state.at = dr.select(hit, self._located(found, segment), state.at)
            state.hit |= hit
            if dr.hint(holes is not None, mode="scalar"):
                si = self._surface(state.at, d, state.hit)
                passes = hit & (rng.chance() >= holes.opacity(si))
                state.hit &= ~passes
                hit &= ~passes
                on = self.leave(si, d).o
                state.o = dr.select(passes, on, state.o)
            else:
                passes = mi.Bool(False)
            # A ray that starts just before the border must not meet the surface behind its start.
            back = dr.select(passes, 0.0, dr.minimum(self.overlap, back + end))

            # Into the next box.
            moves = state.searching & ~hit & ~passes
            p = dr.fma(d, end, state.o)
            along_x = to_x <= to_y
            p.x = dr.select(along_x, dr.select(right, low[0], high[0]), dr.clip(p.x, low[0], high[0]))
            p.y = dr.select(along_x, dr.clip(p.y, low[1], high[1]), dr.select(up, low[1], high[1]))
            gone = dr.select(rising, p.z >= self.top, p.z <= self.bottom)
            state.o = dr.select(moves, p, state.o)
            crossed = moves & ~gone
            state.capped |= crossed & (state.crossings >= max_crossings)
            state.crossings += dr.select(crossed & ~state.capped, mi.UInt32(1), 0)
            state.searching &= ~hit & ~(moves & gone) & ~state.capped
        return state, rng


def _inverse(x: Float) -> Float:
    return dr.rcp(dr.select(x >= 0, dr.maximum(x, _TINY), dr.minimum(x, -_TINY)))


def _wrapped(x: Float, low: Float, size: Float) -> Float:
    """Coordinate within [low, low + size]."""
    return x - dr.floor((x - low) / size) * size

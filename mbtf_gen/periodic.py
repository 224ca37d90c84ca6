"""Rays on an infinitely repeated tile: a ray that leaves the tile re-enters it on the other side.

Coordinates are scene units, centred on the tile. A ray's origin is wrapped into the period; it is traced as
far as the apron reaches; when it hit nothing there it goes on from that point, wrapped again. Successive
pieces overlap by a small length, so that rounding cannot let a ray slip through between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi


@dataclass(frozen=True)
class Period:
    """The box a ray is traced in, all in scene units; ``mi.Float`` of width 1, kept out of the kernels' code
    so that tiles of other sizes use the same compiled kernels.

    Attributes
    ----------
    low : (x, y) of the corner of the period, at the mesh's first vertex
    size : (x, y) lengths of the period
    reach : (x, y) widths of the apron, less a safety margin: how far outside the period rays are traced
    bottom, top : z below and above which nothing lies
    overlap : length by which successive pieces of a ray overlap
    offset : distance from the surface at which a ray that leaves it starts
    """

    low: tuple[Any, Any]
    size: tuple[Any, Any]
    reach: tuple[Any, Any]
    bottom: Any
    top: Any
    overlap: Any
    offset: Any


def wrap(period: Period, p: Any) -> Any:
    """Point moved by whole periods into the period's box."""
    kx = dr.floor((p.x - period.low[0]) / period.size[0])
    ky = dr.floor((p.y - period.low[1]) / period.size[1])
    return mi.Point3f(dr.fma(-kx, period.size[0], p.x), dr.fma(-ky, period.size[1], p.y), p.z)


def _side(position: Any, direction: Any, low: Any, high: Any) -> Any:
    """Distance along a ray to the side of a slab that the ray moves towards; infinite when it moves along
    it."""
    target = dr.select(direction > 0, high, low)
    return dr.select(direction == 0, dr.inf, (target - position) / direction)


def leave(period: Period, si: Any, d: Any) -> Any:
    """Ray that leaves a surface point in direction d.

    The tile is centred on the origin, so hit points are exact to a few units in the last place and a far
    smaller offset than the renderer's own is enough: it would lift rays by 5e-5 tile widths, through thin
    ridges and out of creases.
    """
    side = dr.select(dr.dot(si.n, d) < 0, -period.offset, period.offset)
    return mi.Ray3f(dr.fma(si.n, side, si.p), d)


def piece_length(period: Period, o: Any, d: Any) -> tuple[Any, Any]:
    """(distance to the end of the traced box sideways, distance to the top or bottom) of a ray with a
    wrapped origin."""
    tx = _side(o.x, d.x, period.low[0] - period.reach[0], period.low[0] + period.size[0] + period.reach[0])
    ty = _side(o.y, d.y, period.low[1] - period.reach[1], period.low[1] + period.size[1] + period.reach[1])
    return dr.minimum(tx, ty), dr.maximum(0.0, _side(o.z, d.z, period.bottom, period.top))


def straight(period: Period, ray: Any) -> Any:
    """The ray with its origin in the period, for rays that cannot leave the apron sideways."""
    ray = mi.Ray3f(ray)
    ray.o = wrap(period, ray.o)
    return ray


@dr.syntax
def closest_hit(
    scene: Any,
    period: Period,
    ray: Any,
    active: Any,
    max_crossings: int,
    flags: int = int(mi.RayFlags.All),
    holes: Any = None,
    rng: Any = None,
) -> tuple[Any, Any, Any, Any]:
    """First hit along a ray over the repeated tile.

    Parameters
    ----------
    flags : which parts of the surface interaction are wanted
    holes : ``holes.opacity(si)``, the chance that a hit stops the ray; None where nothing lets rays through
    rng : :class:`~mbtf_gen.sampling.Points` that decide it

    Returns
    -------
    (surface interaction, in wrapped coordinates; crossings spent; lanes that hit the cap; the generator)
    """
    ray = straight(period, ray)
    hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(ray))
    crossings = mi.UInt32(0)
    searching = mi.Bool(active)
    while dr.hint(searching, exclude=[scene, period, holes]):
        side, rise = piece_length(period, ray.o, ray.d)
        ray.maxt = dr.minimum(side, rise)
        found = scene.ray_intersect_preliminary(ray, False, searching)
        stop = searching & found.is_valid()
        onward = wrap(period, ray(dr.maximum(side - period.overlap, 0.0)))
        ends = side >= rise
        if dr.hint(holes is not None, mode="scalar"):
            si = found.compute_surface_interaction(ray, mi.RayFlags.UV, stop)
            passes = stop & (rng.chance() >= holes.opacity(si))
            onward = dr.select(passes, leave(period, si, ray.d).o, onward)
            ends &= ~passes
            stop &= ~passes
        hit[stop] = found
        searching &= ~stop & ~ends & (crossings < max_crossings)
        crossings[searching] += 1
        ray.o[searching] = onward
    capped = active & ~hit.is_valid() & (crossings >= max_crossings)
    si = hit.compute_surface_interaction(ray, flags, active & hit.is_valid())
    return si, crossings, capped, rng


@dr.syntax
def occluded(
    scene: Any,
    period: Period,
    ray: Any,
    active: Any,
    max_crossings: int,
    holes: Any = None,
    rng: Any = None,
) -> tuple[Any, Any, Any, Any]:
    """Whether a ray meets anything over the repeated tile; parameters as of :func:`closest_hit`.

    Returns
    -------
    (occluded; crossings spent; lanes that hit the cap, which count as occluded; the generator)
    """
    ray = straight(period, ray)
    blocked = mi.Bool(False)
    crossings = mi.UInt32(0)
    searching = mi.Bool(active)
    while dr.hint(searching, exclude=[scene, period, holes]):
        side, rise = piece_length(period, ray.o, ray.d)
        ray.maxt = dr.minimum(side, rise)
        onward = wrap(period, ray(dr.maximum(side - period.overlap, 0.0)))
        ends = side >= rise
        if dr.hint(holes is None, mode="scalar"):
            stop = searching & scene.ray_test(ray, False, searching)
        else:
            found = scene.ray_intersect_preliminary(ray, False, searching)
            stop = searching & found.is_valid()
            si = found.compute_surface_interaction(ray, mi.RayFlags.UV, stop)
            passes = stop & (rng.chance() >= holes.opacity(si))
            onward = dr.select(passes, leave(period, si, ray.d).o, onward)
            ends &= ~passes
            stop &= ~passes
        blocked |= stop
        searching &= ~stop & ~ends & (crossings < max_crossings)
        crossings[searching] += 1
        ray.o[searching] = onward
    capped = active & ~blocked & (crossings >= max_crossings)
    return blocked | capped, crossings, capped, rng

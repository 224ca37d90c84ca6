"""The shell of heights of a material over a curved surface: where view rays meet it.

The surface is the top of the shell. A ray that misses the heights passes through, so that silhouettes are
those of the displacement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mbtf_fit.backends.mitsuba.arcs import Arc, on_top, tilt, trace_arcs
from mbtf_fit.backends.mitsuba.curvature import rounded
from mbtf_fit.backends.mitsuba.view_rays import heights_below
from mbtf_fit.ops import Trace
from mbtf_gen.engine.types import Float, Mask, Point2f, Vector2f, Vector3f
from mbtf_gen.tile.tracers.heightfield_tracer import HeightfieldGeometry

# Depth below the lowest height at which rays end, as a share of the shell: the rounding of single precision.
_MARGIN = 1e-3


@dataclass(frozen=True)
class ShellHit:
    """Where view rays meet the heights over a surface.

    Attributes
    ----------
    shell : the heights
    share : rays of the footprint that meet them
    u : uv of the reference plane from which a ray over a plane, in the frame there, meets the same point
    heights : heights of the intersections, one per place
    curvature, flat : of the surface; where it has none
    tilt : change of the normal's horizontal part from the top of the shell to there, an angle
    leaves : whether the ray comes from the shell's top, which curves away from it
    omega_o : towards the viewer in the frame there, raised to the lowest directions with data where curved
    values : results of the operation ``trace``
    """

    shell: Shell
    share: Float
    u: Point2f
    heights: list[Float]
    curvature: Vector3f
    flat: Mask
    tilt: Vector2f
    leaves: Mask
    omega_o: Vector3f
    values: dict[str, list[Float]]


@dataclass(frozen=True)
class Shell:
    """Heights that view rays of a footprint are traced to.

    Attributes
    ----------
    op : the operation
    heightfield : the heights, in tile widths
    aspect : height of the tile over its width
    """

    op: Trace
    heightfield: HeightfieldGeometry
    aspect: float

    @property
    def depth(self) -> Float:
        """Depth at which rays end, below the lowest height by more than rounding."""
        return dr.fma(-(1.0 + _MARGIN), self.heightfield.bottom, 1e-6)

    def places(self, u: Sequence[Float], level: Float, omega_o: Sequence[Float]) -> Iterator[list[Float]]:
        """uv of the places of a footprint, near the first tile: far from it, the rounding of uv would count
        as depth below the surface."""
        u = [c - dr.floor(c) for c in u]
        sigma = 0.5 * dr.exp2(-level)
        flat = mi.Vector2f(omega_o[0], omega_o[1])
        length = dr.sqrt(dr.fma(flat.x, flat.x, dr.square(flat.y)))
        along = dr.select(length > 0.0, flat / length, mi.Vector2f(1.0, 0.0))
        for x, y in self.op.places:
            yield [
                u[0] + sigma * (y * along.x - x * along.y),
                u[1] + sigma * ((y * along.y + x * along.x) / self.aspect),
            ]

    def flat_heights(
        self, places: Sequence[Sequence[Float]], omega_o: Sequence[Float], active: Mask = True
    ) -> list[Float]:
        """Heights at which rays through points of a plane meet the heights."""
        rays = [mi.Ray3f(on_top(u, self.aspect), -mi.Vector3f(*omega_o)) for u in places]
        return heights_below(self.heightfield, rays, self.op.crossings, active)

    def meet(
        self,
        u: Point2f,
        level: Float,
        omega_o: Vector3f,
        curvature: Vector3f,
        min_cos: Float,
        rise: Float,
        over: Callable[[Vector2f], Vector3f],
    ) -> ShellHit:
        """Trace view rays over a surface of curvatures (xx, xy, yy), in 1/tile width. Along the
        normal, they come from a distance `rise` below. `over` is the direction towards the viewer in the
        frame at a tilt."""
        curvature = mi.Vector3f(*rounded(curvature, self.depth))
        flat = (curvature.x == 0) & (curvature.y == 0) & (curvature.z == 0)
        arc = Arc.of(-omega_o, curvature, self.depth, float(self.op.crossings))
        lowest = clamped(omega_o, min_cos)
        found = []
        places = list(self.places(u, level, lowest))
        arcs = trace_arcs(self.heightfield, places, arc, self.aspect, ~flat)
        for at, over_plane, (hit, s, z) in zip(
            places, self.flat_heights(places, lowest, flat), arcs, strict=True
        ):
            place = [
                dr.select(flat, a, dr.fma(s, b, c))
                for a, b, c in zip(
                    displaced(at, over_plane, lowest, self.aspect),
                    (arc.azimuth.x, arc.azimuth.y / self.aspect),
                    at,
                    strict=True,
                )
            ]
            found.append((hit | flat, dr.select(flat, over_plane, z), s, place))
        count = sum(dr.select(hit, mi.Float(1.0), 0.0) for hit, *_ in found)

        def mean(values: Iterable[tuple[Mask, Float]]) -> Float:
            return sum(dr.select(hit, value, 0.0) for hit, value in values) / dr.maximum(count, 1.0)

        z, s, x, y = (
            mean((hit, (height, along, *place)[k]) for hit, height, along, place in found) for k in range(4)
        )
        # Places whose ray misses do not count.
        hits = [
            c
            for hit, _, _, place in found
            for c in (dr.select(hit, place[0], x), dr.select(hit, place[1], y))
        ]
        bend = dr.select(flat, 0.0, s) * tilt(curvature, arc.azimuth)
        # From behind, the ray meets no heights.
        still = flat | (omega_o.z <= 0.0)
        there = dr.select(still, omega_o, clamped(over(bend), min_cos))
        before = displaced([x, y], -z, there, self.aspect)
        heights = [dr.select(hit, height, z) for hit, height, *_ in found]
        return ShellHit(
            self,
            count / len(found),
            dr.select(still, u, mi.Point2f(*before)),
            heights,
            curvature,
            flat,
            bend,
            # Over a sphere, a ray gets at least a quarter of its rise deep, at most half: some pass that
            # met the bottom; none stays that left.
            ~flat & (arc.curvature > 0.0) & (rise < 4.0 * self.depth),
            there,
            {self.op.output: [z], self.op.hits: hits, self.op.depths: heights},
        )


def clamped(w: Vector3f, min_cos: Float) -> Vector3f:
    """Directions, raised to the lowest ones with data."""
    sine, largest = dr.sqrt(dr.fma(w.x, w.x, w.y * w.y)), dr.sqrt(1.0 - min_cos * min_cos)
    low = (sine > largest) | (w.z < 0)
    scale = dr.select(low, largest / sine, 1.0)
    return mi.Vector3f(w.x * scale, w.y * scale, dr.select(low, min_cos, w.z))


def displaced(u: Sequence[Float], height: Float, omega_o: Sequence[Float], aspect: float) -> list[Float]:
    """uv of the points at heights on lines through points of the plane."""
    step = height / omega_o[2]
    return [dr.fma(step, omega_o[0], u[0]), dr.fma(step / aspect, omega_o[1], u[1])]

"""Fibers of one period: tubes around uniform cubic B-splines, see
:mod:`~mbtf_gen.tile.tracers.periodic_scene`.

Mitsuba finds the curve and the parameter of a hit. The hit is then moved along the normal onto the tube, from
the control points, so that its distance from the axis is exact to a few units in the last place. Scattered
rays start a hundredth of the thinnest sensible fiber's radius from there.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mbtf_gen.engine.types import Float, Mask, Point3f, Ray3f, SurfaceInteraction3f, UInt32, Vector3f, padded
from mbtf_gen.tile.tracers.periodic_scene import OVERLAP, PeriodicScene
from mbtf_gen.tile.tracers.protocol import Vertex

# Distance at which scattered rays start, relative to the largest coordinate: a hundredth of the radius of a
# fiber of 1e-4 tile widths. At a quarter of it, 8 in 10⁵ rays met their own fiber again.
_OFFSET = 2.0e-6


@dataclass(frozen=True)
class CurveGeometry(PeriodicScene):
    """Fibers that reach into the box of one period. Rays that miss them leave on the other side.

    Attributes
    ----------
    points : control points; radii : at the control points
    first : number of the first of the four control points of each segment
    u : texture coordinate of each segment, which selects its color
    part : surface of each segment; None for a single one
    """

    points: Point3f
    radii: Float
    first: UInt32
    u: Float
    part: UInt32 | None
    open = True

    @classmethod
    def of_runs(
        cls,
        runs: list[NDArray[np.float64]],
        u: NDArray[np.float64],
        part: NDArray[np.int_] | None,
        aspect: float,
        thickness: float,
        unit: float,
    ) -> CurveGeometry:
        """Fibers as runs of control points (m, 4), in tile widths, that reach into the box of one period.

        Parameters
        ----------
        runs, u, part : control points, texture coordinate and surface of each run
        aspect, thickness : height of the tile over its width; height of the fibers' slab
        unit : scene units per tile width
        """
        size = (unit, unit * aspect)
        points = np.concatenate(runs)
        points[:, :3] -= (0.5, 0.5 * aspect, 0.0)
        rows: NDArray[np.float32] = (points * unit).astype(np.float32)
        lengths = np.array([len(run) for run in runs])
        segments = lengths - 3
        start = np.cumsum(lengths) - lengths
        within = np.arange(segments.sum()) - np.repeat(np.cumsum(segments) - segments, segments)
        depth = thickness * unit
        extent = max(0.5 * size[0], 0.5 * size[1], depth)
        number = partial(dr.opaque, mi.Float)
        return cls(
            mi.load_dict({"type": "scene", "curves": _shape(rows, start[1:])}),
            (number(-0.5 * size[0]), number(-0.5 * size[1])),
            (number(size[0]), number(size[1])),
            number(-depth),
            number(0.0),
            number(_OFFSET * extent),
            number(OVERLAP * extent),
            mi.Point3f(padded(rows[:, :3].T)),
            mi.Float(padded(rows[:, 3])),
            mi.UInt32(padded((np.repeat(start, segments) + within).astype(np.uint32))),
            mi.Float(padded(np.repeat(u, segments).astype(np.float32))),
            None if part is None else mi.UInt32(padded(np.repeat(part, segments).astype(np.uint32))),
        )

    def vertex(self, si: SurfaceInteraction3f) -> Vertex:
        """Position, normal, direction around the fiber, color and surface."""
        part = None if self.part is None else mi.UInt32(si.prim_index)
        p, n = mi.Point3f(si.p), mi.Normal3f(si.n)
        return Vertex(p, n, mi.Vector3f(si.sh_frame.s), mi.Point2f(si.uv), part)

    def interaction(self, vertex: Vertex, d: Vector3f, valid: Mask) -> SurfaceInteraction3f:
        """Surface interaction at a vertex, in the frame that Mitsuba's ``hair`` expects: x around the fiber,
        y along it."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(vertex.p))
        si.t = dr.select(valid, mi.Float(0.0), dr.inf)
        si.p, si.n, si.uv = vertex.p, vertex.n, vertex.uv
        n = mi.Vector3f(vertex.n)
        si.sh_frame = mi.Frame3f(vertex.s, dr.cross(n, vertex.s), n)
        si.dp_du, si.dp_dv = vertex.s, si.sh_frame.t
        si.wi = si.to_local(-d)
        if vertex.part is not None:
            si.prim_index = vertex.part
        return si

    def _located(self, found: Any, segment: Ray3f) -> Any:
        """Segment, parameter along it, and position."""
        return found.prim_index, found.prim_uv.x, segment(dr.select(found.is_valid(), found.t, 0.0))

    def _surface(self, at: Any, d: Vector3f, valid: Mask) -> SurfaceInteraction3f:
        prim, v, near = at
        first = dr.gather(mi.UInt32, self.first, prim, valid)
        w = 1.0 - v
        # Uniform cubic B-spline and its derivative.
        basis = (w * w * w, (3.0 * v - 6.0) * v * v + 4.0, ((3.0 - 3.0 * v) * v + 3.0) * v + 1.0, v * v * v)
        slope = (-w * w, (3.0 * v - 4.0) * v, (2.0 - 3.0 * v) * v + 1.0, v * v)
        center, along = mi.Vector3f(0.0), mi.Vector3f(0.0)
        radius, growth = mi.Float(0.0), mi.Float(0.0)
        for k in range(4):
            p = mi.Vector3f(dr.gather(mi.Point3f, self.points, first + k, valid))
            r = dr.gather(mi.Float, self.radii, first + k, valid)
            center, along = dr.fma(p, basis[k] / 6.0, center), dr.fma(p, 0.5 * slope[k], along)
            radius, growth = dr.fma(r, basis[k] / 6.0, radius), dr.fma(r, 0.5 * slope[k], growth)
        speed = dr.maximum(dr.norm(along), 1e-30)
        tangent = along / speed
        out = mi.Vector3f(near) - center
        out = dr.normalize(dr.fma(tangent, -dr.dot(out, tangent), out))
        position = mi.Point3f(dr.fma(out, radius, center))
        # Where the radius grows, the tube's surface leans back.
        n = dr.normalize(dr.fma(tangent, -growth / speed, out))
        u = dr.gather(mi.Float, self.u, prim, valid)
        part = None if self.part is None else dr.gather(mi.UInt32, self.part, prim, valid)
        vertex = Vertex(position, mi.Normal3f(n), dr.cross(tangent, out), mi.Point2f(u, 0.5), part)
        return self.interaction(vertex, d, valid)


def _shape(points: NDArray[np.float32], starts: NDArray[np.int_]) -> Any:
    """Mitsuba's shape of control points (n, 4), split before the given rows; Mitsuba reads it from a file."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "curves.txt"
        with file.open("w", encoding="ascii") as text:
            for run in np.split(points, starts):
                # Nine digits distinguish all float32.
                text.writelines(f"{x:.9g} {y:.9g} {z:.9g} {r:.9g}\n" for x, y, z, r in run.tolist())
                text.write("\n")
        return mi.load_dict({"type": "bsplinecurve", "filename": str(file)})

"""Triangles of one period, see :mod:`~mbtf_gen.render.periodic_scene`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_gen.geometry.heightfield import HeightGrid, grid_faces, grid_vertices
from mbtf_gen.render.geometry import Vertex
from mbtf_gen.render.heightfield import surface_interaction
from mbtf_gen.render.periodic_scene import OVERLAP, PeriodicScene
from mbtf_gen.render.types import Mask, Point3f, Ray3f, SurfaceInteraction3f, Vector3f

# Distance at which scattered rays start, relative to the largest coordinate.
_OFFSET = 5.0e-7
# Each cell takes about 300 bytes, with Mitsuba's and Embree's own data.
MOST_CELLS = 1 << 24


@dataclass(frozen=True)
class MeshGeometry(PeriodicScene):
    """Triangles that cover one period and its seams. Rays may start on either side of them.

    Attributes
    ----------
    vertices, faces : of the triangles
    """

    vertices: Point3f
    faces: Any
    open = False

    @classmethod
    def of_grid(cls, grid: HeightGrid, unit: float) -> MeshGeometry:
        """The triangles of a height grid: those that :mod:`~mbtf_gen.render.heightfield_tracer` traces."""
        if grid.z.size > MOST_CELLS:
            raise InputError(
                f"a mesh of {grid.z.size:,} cells is too large for triangles; at most {MOST_CELLS:,} are",
                where="geometry.tracer",
                hint="reduce --mesh, or use --tracer heightfield",
            )
        # One more cell on each side: rays along the seam meet triangles on either side of it.
        vertices = (grid_vertices(grid, (1, 1)) - (0.5, 0.5 * grid.aspect, 0.0)) * unit
        rows, columns = grid.z.shape
        low = (0.5 * unit * (1.0 / columns - 1.0), 0.5 * unit * grid.aspect * (1.0 / rows - 1.0))
        faces = grid_faces(*vertices.shape[:2])
        return cls.of_triangles(vertices.reshape(-1, 3), faces, low, (unit, unit * grid.aspect))

    @classmethod
    def of_triangles(
        cls,
        vertices: NDArray[np.float64],
        faces: NDArray[np.uint32],
        low: tuple[float, float],
        size: tuple[float, float],
    ) -> MeshGeometry:
        """Triangles (m, 3) between vertices (n, 3) in scene units: all that reach into the box of one period,
        whose first corner is `low`."""
        mesh = mi.Mesh("tile", len(vertices), len(faces))
        params = mi.traverse(mesh)
        params["vertex_positions"] = vertices.astype(np.float32).ravel()
        params["faces"] = faces.ravel()
        params.update()
        number = partial(dr.opaque, mi.Float)
        extent = float(max(0.5 * size[0], 0.5 * size[1], np.ptp(vertices[:, 2])))
        return cls(
            mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "mesh": mesh}),
            (number(low[0]), number(low[1])),
            (number(size[0]), number(size[1])),
            number(float(vertices[:, 2].min())),
            number(float(vertices[:, 2].max())),
            number(_OFFSET * extent),
            number(OVERLAP * extent),
            mi.Point3f(vertices.T.astype(np.float32).copy()),
            mi.Vector3u(faces.T.astype(np.uint32).copy()),
        )

    def vertex(self, si: SurfaceInteraction3f) -> Vertex:
        """Position and normal."""
        return Vertex(mi.Point3f(si.p), mi.Normal3f(si.n))

    def interaction(self, vertex: Vertex, d: Vector3f, valid: Mask) -> SurfaceInteraction3f:
        """Surface interaction at a vertex, with the texture coordinates of a height field."""
        return surface_interaction(vertex.p, vertex.n, d, valid, self.size)

    def _located(self, found: Any, segment: Ray3f) -> Any:
        """Triangle and barycentric coordinates."""
        return found.prim_index, found.prim_uv

    def _surface(self, at: Any, d: Vector3f, valid: Mask) -> SurfaceInteraction3f:
        """Positions from barycentric coordinates are exact to a few units in the last place, whatever the
        length of the ray."""
        prim, uv = at
        face = dr.gather(type(self.faces), self.faces, prim, valid)
        a, b, c = (dr.gather(mi.Point3f, self.vertices, face[k], valid) for k in range(3))
        p = dr.fma(b - a, uv.x, dr.fma(c - a, uv.y, a))
        n = dr.normalize(mi.Normal3f(dr.cross(b - a, c - a)))
        return self.interaction(Vertex(p, n), d, valid)

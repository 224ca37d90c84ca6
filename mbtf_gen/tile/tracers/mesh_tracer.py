"""Triangles of one period, see :mod:`~mbtf_gen.tile.tracers.periodic_scene`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mbtf_gen.engine.types import (
    Mask,
    Normal3f,
    Point2f,
    Point3f,
    Ray3f,
    SurfaceInteraction3f,
    UInt32,
    Vector3f,
    padded,
)
from mbtf_gen.tile.tracers.heightfield import surface_interaction
from mbtf_gen.tile.tracers.periodic_scene import OVERLAP, PeriodicScene
from mbtf_gen.tile.tracers.protocol import Vertex

# Distance at which scattered rays start, relative to the largest coordinate.
_OFFSET = 5.0e-7


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
    def of_cells(
        cls, vertices: NDArray[np.float64], faces: NDArray[np.uint32], aspect: float, unit: float
    ) -> MeshGeometry:
        """The triangles of a height grid, those that the height-field tracer follows.

        Parameters
        ----------
        vertices : (rows + 3, columns + 3, 3) positions in tile widths of one period, with one more cell on
            each side: rays along the seam meet triangles on either side of it
        faces : (m, 3) vertices of each triangle
        aspect : H/W of the tile
        unit : scene units per tile width
        """
        rows, columns = (size - 3 for size in vertices.shape[:2])
        placed = (vertices - (0.5, 0.5 * aspect, 0.0)) * unit
        low = (0.5 * unit * (1.0 / columns - 1.0), 0.5 * unit * aspect * (1.0 / rows - 1.0))
        return cls(**_triangles(placed.reshape(-1, 3), faces, low, (unit, unit * aspect)))

    def vertex(self, si: SurfaceInteraction3f) -> Vertex:
        return Vertex(mi.Point3f(si.p), mi.Normal3f(si.n))

    def interaction(self, vertex: Vertex, d: Vector3f, valid: Mask) -> SurfaceInteraction3f:
        """Surface interaction at a vertex, with the texture coordinates of a height field."""
        return surface_interaction(vertex.p, vertex.n, d, valid, self.size)

    def _located(self, found: Any, segment: Ray3f) -> Any:
        """Triangle and barycentric coordinates."""
        return found.prim_index, found.prim_uv

    def _surface(self, at: Any, d: Vector3f, valid: Mask) -> SurfaceInteraction3f:
        p, n, _ = self._hit(at, valid)
        return self.interaction(Vertex(p, n), d, valid)

    def _hit(self, at: Any, valid: Mask) -> tuple[Point3f, Normal3f, Any]:
        """Positions from barycentric coordinates, exact to a few units in the last place, whatever the length
        of the ray; normals; numbers of the triangles' vertices."""
        prim, uv = at
        face = dr.gather(type(self.faces), self.faces, prim, valid)
        a, b, c = (dr.gather(mi.Point3f, self.vertices, face[k], valid) for k in range(3))
        p = dr.fma(b - a, uv.x, dr.fma(c - a, uv.y, a))
        return p, dr.normalize(mi.Normal3f(dr.cross(b - a, c - a))), face


@dataclass(frozen=True)
class MeshTileGeometry(MeshGeometry):
    """Triangles of a mesh, both of whose sides reflect. Rays that miss them leave on the other side.

    Attributes
    ----------
    uv : texture coordinates of the vertices
    part : surface of each triangle
    """

    uv: Point2f
    part: UInt32
    open = True

    @classmethod
    def of_triangles(
        cls,
        corners: NDArray[np.float64],
        uv: NDArray[np.float64],
        part: NDArray[np.int_],
        aspect: float,
        unit: float,
    ) -> MeshTileGeometry:
        """Triangles, in tile widths, that reach into the box of one period.

        Parameters
        ----------
        corners, uv : positions (m, 3, 3) and texture coordinates (m, 3, 2) of the triangles' corners
        part : (m,) surface of each triangle
        aspect : height of the tile over its width
        unit : scene units per tile width
        """
        vertices = (corners - (0.5, 0.5 * aspect, 0.0)) * unit
        faces = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
        size = (unit, unit * aspect)
        low = (-0.5 * size[0], -0.5 * size[1])
        return cls(
            **_triangles(vertices.reshape(-1, 3), faces, low, size),
            # Mitsuba's bitmaps have row 0 at v = 0, ours at v → 1.
            uv=mi.Point2f(padded((uv.reshape(-1, 2) * (1, -1) + (0, 1)).T.astype(np.float32))),
            part=mi.UInt32(padded(part.astype(np.uint32))),
        )

    def vertex(self, si: SurfaceInteraction3f) -> Vertex:
        """Position, normal, texture coordinates and part."""
        return Vertex(mi.Point3f(si.p), mi.Normal3f(si.n), None, mi.Point2f(si.uv), mi.UInt32(si.prim_index))

    def interaction(self, vertex: Vertex, d: Vector3f, valid: Mask) -> SurfaceInteraction3f:
        """Surface interaction at a vertex, on the side that the ray comes from."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(vertex.p))
        si.t = dr.select(valid, mi.Float(0.0), dr.inf)
        si.p, si.uv, si.prim_index = vertex.p, vertex.uv, vertex.part
        si.n = dr.select(dr.dot(vertex.n, d) > 0, -vertex.n, vertex.n)
        si.sh_frame = mi.Frame3f(mi.Vector3f(si.n))
        si.dp_du, si.dp_dv = si.sh_frame.s, si.sh_frame.t
        si.wi = si.to_local(-d)
        return si

    def _surface(self, at: Any, d: Vector3f, valid: Mask) -> SurfaceInteraction3f:
        p, n, face = self._hit(at, valid)
        a, b, c = (dr.gather(mi.Point2f, self.uv, face[k], valid) for k in range(3))
        uv = a + (b - a) * at[1].x + (c - a) * at[1].y
        part = dr.gather(mi.UInt32, self.part, at[0], valid)
        return self.interaction(Vertex(p, n, None, uv, part), d, valid)


def _triangles(
    vertices: NDArray[np.float64],
    faces: NDArray[np.uint32],
    low: tuple[float, float],
    size: tuple[float, float],
) -> dict[str, Any]:
    """Attributes of the geometry of triangles (m, 3) between vertices (n, 3) in scene units: all that reach
    into the box of one period, whose first corner is `low`."""
    mesh = mi.Mesh("tile", len(vertices), len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"] = vertices.astype(np.float32).ravel()
    params["faces"] = faces.ravel()
    params.update()
    number = partial(dr.opaque, mi.Float)
    extent = float(max(0.5 * size[0], 0.5 * size[1], np.ptp(vertices[:, 2])))
    return {
        "scene": mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "mesh": mesh}),
        "low": (number(low[0]), number(low[1])),
        "size": (number(size[0]), number(size[1])),
        "bottom": number(float(vertices[:, 2].min())),
        "top": number(float(vertices[:, 2].max())),
        "offset": number(_OFFSET * extent),
        "overlap": number(OVERLAP * extent),
        "vertices": mi.Point3f(padded(vertices.T.astype(np.float32))),
        "faces": mi.Vector3u(padded(faces.T.astype(np.uint32))),
    }

"""Displaced periodic tile: heights on a grid → triangles.

Mesh vertices sit on texel centers of the grid, ``uv = ((i+½)/W, 1-(j+½)/H)``, heights are
``z = scale · h - max(scale · h)``, and the cell between the last and the first column (row) closes the
period. Meshes for other renderers may have an apron of repeated cells around the period, so that a ray near
its border meets surface on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_gen.config.generator import Tracer
from mbtf_gen.tile.tracers.protocol import TileGeometry

# Cells of a grid that Mitsuba traces. Each takes about 300 bytes, with Mitsuba's and Embree's own data.
MOST_CELLS = 1 << 24


@dataclass(frozen=True)
class HeightGrid:
    """Heights of one tile.

    Attributes
    ----------
    z : (H, W) float64 array
        Heights ≤ 0 in tile widths, maximum 0; row 0 is the side ``v → 1``.
    aspect : float
        H/W of the tile.
    tracer : {"heightfield", "mesh"}
        How rays find the surface: cell by cell, or by Mitsuba as triangles.
    """

    z: NDArray[np.float64]
    aspect: float
    tracer: Tracer = "heightfield"

    @classmethod
    def from_map(cls, heights: NDArray[np.float64], scale: float, aspect: float | None = None) -> HeightGrid:
        """Grid of a height map (H, W) of stored numbers: ``z = scale · h - max(scale · h)``, so that a
        negative scale inverts the heights; aspect H/W by default.
        """
        z = scale * np.asarray(heights, np.float64)
        rows, columns = z.shape
        return cls(z - z.max(), rows / columns if aspect is None else aspect)

    @property
    def displacement_range(self) -> float:
        """Largest height difference in tile widths."""
        return float(self.z.max() - self.z.min())

    def trace(self, unit: float, below: bool = False) -> TileGeometry:
        """The surface as rays meet it, see :meth:`mbtf_gen.tile.protocol.Tile.trace`.

        Raises
        ------
        InputError
            Mitsuba would trace too many triangles.
        """
        if self.tracer == "heightfield":
            from mbtf_gen.tile.tracers.heightfield_tracer import HeightfieldGeometry

            return HeightfieldGeometry.of(self, unit, below)
        if self.z.size > MOST_CELLS:
            raise InputError(
                f"a mesh of {self.z.size:,} cells is too large for triangles; at most {MOST_CELLS:,} are",
                where="geometry.tracer",
                hint="reduce --mesh, or use --tracer heightfield",
            )
        from mbtf_gen.tile.tracers.mesh_tracer import MeshGeometry

        vertices = grid_vertices(self, (1, 1))
        return MeshGeometry.of_cells(vertices, grid_faces(*vertices.shape[:2]), self.aspect, unit)


def grid_vertices(grid: HeightGrid, apron: tuple[int, int] = (0, 0)) -> NDArray[np.float64]:
    """Vertices (rows, columns, 3) as (x, y, z) in tile widths, x = u, y = a·v, from the period's first
    vertex to the first vertex of the next period, plus `apron` = (rows, columns) cells on each side."""
    rows, columns = grid.z.shape
    j = np.arange(-apron[0], rows + 1 + apron[0])
    i = np.arange(-apron[1], columns + 1 + apron[1])
    x = (i + 0.5) / columns
    y = grid.aspect * (1.0 - (j + 0.5) / rows)
    z = grid.z[np.ix_(j % rows, i % columns)]
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None], z), axis=-1)


def grid_faces(rows: int, columns: int) -> NDArray[np.uint32]:
    """Triangles (2·(rows-1)·(columns-1), 3) of a grid of vertices, counter-clockwise seen from above."""
    index = np.arange(rows * columns, dtype=np.uint32).reshape(rows, columns)
    top_left, top_right = index[:-1, :-1], index[:-1, 1:]
    low_left, low_right = index[1:, :-1], index[1:, 1:]
    first = np.stack([top_left, low_left, low_right], axis=-1)
    second = np.stack([top_left, low_right, top_right], axis=-1)
    return np.stack([first, second], axis=2).reshape(-1, 3)


def tile_mesh(grid: HeightGrid) -> Any:
    """One period of the tile as a :class:`trimesh.Trimesh` with texture coordinates; lengths in tile
    widths."""
    import trimesh

    vertices = grid_vertices(grid)
    rows, columns = vertices.shape[:2]
    flat = vertices.reshape(-1, 3)
    uv = flat[:, :2] / (1.0, grid.aspect)
    mesh = trimesh.Trimesh(flat, grid_faces(rows, columns), process=False)
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv)
    return mesh


def mesh_of_grid(grid: HeightGrid, unit: float, apron: tuple[int, int], bsdf: Any) -> Any:
    """Mitsuba mesh of one period of the tile centered on the origin, with `unit` scene units per tile width
    and an `apron` of (rows, columns) cells on each side, for comparisons with unmodified Mitsuba."""
    import mitsuba as mi

    vertices = grid_vertices(grid, apron)
    flat, faces = vertices.reshape(-1, 3), grid_faces(*vertices.shape[:2])
    props = mi.Properties()
    props["bsdf"] = bsdf
    # Interpolated normals lose energy on coarse grids.
    props["face_normals"] = True
    mesh = mi.Mesh("tile", len(flat), len(faces), props=props, has_vertex_texcoords=True)
    params = mi.traverse(mesh)
    centered = (flat - (0.5, 0.5 * grid.aspect, 0.0)) * unit
    params["vertex_positions"] = centered.astype(np.float32).ravel()
    # Mitsuba's bitmaps have row 0 at v = 0, ours at v → 1: its texture coordinates are (u, 1-v).
    texcoords = np.column_stack([flat[:, 0], 1.0 - flat[:, 1] / grid.aspect])
    params["vertex_texcoords"] = texcoords.astype(np.float32).ravel()
    params["faces"] = faces.ravel()
    params.update()
    return mesh

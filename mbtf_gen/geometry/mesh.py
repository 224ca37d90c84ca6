"""The tile as a Mitsuba mesh, for comparisons with unmodified Mitsuba; the generator does not use it."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from mbtf_gen.geometry.heightfield import HeightGrid, grid_faces, grid_vertices


def mesh_of_grid(grid: HeightGrid, unit: float, apron: tuple[int, int], bsdf: Any) -> Any:
    """Mitsuba mesh of one period of the tile with an apron, in scene units.

    Parameters
    ----------
    grid : HeightGrid
        Heights in tile widths.
    unit : float
        Scene units per tile width.
    apron : tuple of int
        (rows, columns) of cells that are repeated on each side.
    bsdf : mitsuba.BSDF
        Reflection of the mesh.
    """
    vertices = grid_vertices(grid, apron)
    rows, columns = vertices.shape[:2]
    flat = vertices.reshape(-1, 3)
    faces = grid_faces(rows, columns)
    props = mi.Properties()
    props["bsdf"] = bsdf
    # Face normals: interpolated normals lose energy on coarse grids.
    props["face_normals"] = True
    mesh = mi.Mesh("tile", len(flat), len(faces), props=props, has_vertex_texcoords=True)
    center = np.array([0.5, 0.5 * grid.aspect, 0.0])
    params = mi.traverse(mesh)
    params["vertex_positions"] = ((flat - center) * unit).astype(np.float32).ravel()
    # Mitsuba's bitmaps have row 0 at v = 0, ours at v → 1: its texture coordinates are (u, 1-v).
    texcoords = np.column_stack([flat[:, 0], 1.0 - flat[:, 1] / grid.aspect])
    params["vertex_texcoords"] = texcoords.astype(np.float32).ravel()
    params["faces"] = faces.ravel()
    params.update()
    return mesh

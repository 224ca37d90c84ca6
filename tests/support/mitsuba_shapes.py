"""Shapes of unmodified Mitsuba for one period of a tile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from mbtf_gen.tile.fiber_tile import FiberTile
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_gen.tile.heights import HeightGrid, grid_faces, grid_vertices
from mbtf_gen.tile.protocol import Tile


def mitsuba_shapes(tile: Tile, unit: float, folder: Path, bsdf: Mapping[str, Any]) -> dict[str, Any]:
    """Shapes of one period, centered.

    Parameters
    ----------
    tile : a height field or fibers
    unit : scene units per tile width
    folder : where files of shapes are written
    bsdf : reflectance of a height field; fibers have their own
    """
    if isinstance(tile, FiberTile):
        return _curves(tile, unit, folder)
    assert isinstance(tile, HeightFieldTile)
    return {"tile": height_field(tile.grid, unit, folder, bsdf)}


def tile_mesh(grid: HeightGrid) -> Any:
    """One period of the tile as a :class:`trimesh.Trimesh` with texture coordinates; lengths in tile
    widths."""
    vertices = grid_vertices(grid)
    rows, columns = vertices.shape[:2]
    flat = vertices.reshape(-1, 3)
    uv = flat[:, :2] / (1.0, grid.aspect)
    mesh = trimesh.Trimesh(flat, grid_faces(rows, columns), process=False)
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv)
    return mesh


def height_field(grid: HeightGrid, unit: float, folder: Path, bsdf: Mapping[str, Any]) -> dict[str, Any]:
    """The shape of one period of heights."""
    mesh = tile_mesh(grid)
    mesh.apply_translation([-0.5, -0.5 * grid.aspect, 0.0])
    mesh.apply_scale(unit)
    file = folder / "tile.ply"
    file.write_bytes(mesh.export(file_type="ply", vertex_normal=False))
    flat = {"face_normals": True, "flip_tex_coords": True}
    return {"type": "ply", "filename": str(file), **flat, "bsdf": dict(bsdf)}


def _curves(tile: FiberTile, unit: float, folder: Path) -> dict[str, Any]:
    """One shape per color: Mitsuba's own texture coordinates run around the fiber."""
    out: dict[str, Any] = {}
    for color in np.unique(tile.yarn):
        file = folder / f"color_{color}.txt"
        with file.open("w") as text:
            for number in np.flatnonzero(tile.yarn == color):
                points = tile.curves[int(number)].unrolled() - (0.5, 0.5 * tile.aspect, 0.0, 0.0)
                np.savetxt(text, points * unit, fmt="%.9g")
                text.write("\n")
        own = replace(tile, colors=tile.colors[[color]], scattering=(tile.scattering[color],)).surface()
        out[f"color_{color}"] = {"type": "bsplinecurve", "filename": str(file), "bsdf": own}
    return out

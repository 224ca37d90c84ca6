"""Meshes with texture coordinates that a material displaces.

A point of a mesh lies at ``p + s z n``: position p and normal n are interpolated between the vertices, s is
the width of a tile there, and z ≤ 0 the height of the material. The triangles of the heights are cut at those
of the mesh, so that the heights are exact. Where texture coordinates have a seam, the surface closes if the
heights on both sides agree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.meshes.content import F64, I64, MeshShape, joined, triangle_areas
from mbtf_core.meshes.read import read_mesh_content
from mbtf_gen.pictures.shapes import check_cells, mitsuba_mesh
from mbtf_gen.tile.heights import HeightGrid

# Half cells that are cut at once.
_PASS = 1 << 20
# Area of a piece over that of its half cell, below which it is rounding.
_SLIVER = 1e-9
# The triangles of a cell, counterclockwise.
_HALVES = np.array([[[0, 0], [1, 0], [0, 1]], [[1, 1], [0, 1], [1, 0]]], np.float64)


@dataclass(frozen=True)
class DisplacedMesh:
    """A mesh with tiles; lengths are in mean tile widths.

    Attributes
    ----------
    name : of its pictures
    aspect : height of a tile over its width
    position, normal : (n, 3), positions around the origin, and unit normals
    width : (n,) widths of a tile
    tile : (n, 2), places of the vertices in the tiles, y upwards, in tile widths
    faces : (m, 3) vertices of each triangle, counterclockwise seen from outside
    """

    name: str
    aspect: float
    position: F64
    normal: F64
    width: F64
    tile: F64
    faces: I64

    @property
    def radius(self) -> float:
        """Largest distance from the origin."""
        return float(np.linalg.norm(self.position, axis=1).max())

    @classmethod
    def read(cls, path: Path, tiles: float, aspect: float, up: Literal["y", "z"] | None) -> DisplacedMesh:
        """A file's mesh, with so many tiles per unit of its texture coordinates.

        The normal at a position is the mean of those of the triangles around it, weighted by their angles;
        the width of a tile is that of their areas together.

        Raises
        ------
        InputError : the file is no mesh, or its texture coordinates are missing or have no area
        """
        content = read_mesh_content(path)
        for shape in content.shapes:
            _check(shape, path)
        vertices, faces = joined(content.shapes)
        uv = np.concatenate([shape.uv for shape in content.shapes if shape.uv is not None])
        tile = tiles * (uv - (0.0, 1.0)) + (0.0, aspect)
        if (up or content.up) == "y":
            vertices = vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
        faces = faces[triangle_areas(vertices, faces) > 0]
        area, placed = triangle_areas(vertices, faces), abs(triangle_areas(tile, faces))
        if not len(faces) or not placed.min() > 0:
            what = f"{np.sum(placed == 0):,} of {len(faces):,} triangles have no area in texture coordinates"
            raise InputError(what, where=path, hint="unwrap the mesh")
        import trimesh

        points, same = np.unique(vertices, axis=0, return_inverse=True)
        same = same.reshape(-1)
        around = [np.bincount(same[faces].ravel(), np.repeat(x, 3), len(points)) for x in (area, placed)]
        width = np.sqrt(around[0] / np.where(around[1] > 0, around[1], 1.0))
        unit = float(np.sqrt(area.sum() / placed.sum()))
        used = vertices[faces].reshape(-1, 3)
        position = (vertices - 0.5 * (used.min(0) + used.max(0))) / unit
        normal = trimesh.Trimesh(points, same[faces], process=False).vertex_normals
        return cls(path.stem, aspect, position, normal[same], width[same] / unit, tile, faces)

    def mesh(self, grid: HeightGrid | None, bsdf: Any) -> Any:
        """The displaced shape as a mesh of Mitsuba; without heights the smooth one.

        Texture coordinates are in tile widths over (1, aspect), v downwards.

        Raises
        ------
        InputError : too many triangles
        """
        if grid is None:
            return mitsuba_mesh("shape", bsdf, self.position, self._uv(self.tile), self.faces, self.normal)
        cells = self._texels(grid)
        count = int(np.abs(triangle_areas(cells, self.faces)).sum()) + len(self.faces)
        check_cells("mesh", count, grid.z.shape[1])
        parts = np.concatenate([self._displaced(grid, cells, *p) for p in _pieces(cells, self.faces)])
        position, uv = parts[..., :3].reshape(-1, 3), parts[..., 3:].reshape(-1, 2)
        faces = np.arange(len(position)).reshape(-1, 3)
        return mitsuba_mesh("shape", bsdf, position, uv, faces, flat=True)

    def _uv(self, tile: F64) -> F64:
        return (0.0, 1.0) + tile / (1.0, -self.aspect)

    def _texels(self, grid: HeightGrid) -> F64:
        rows, columns = grid.z.shape
        return self.tile / (1.0, self.aspect) * (columns, rows) - 0.5

    def _displaced(self, grid: HeightGrid, cells: F64, face: I64, weights: F64) -> NDArray[np.float32]:
        """Positions and texture coordinates (k, 3, 5) of pieces (k, 3, 3) of faces (k,)."""
        corners = self.faces[face]

        def at(values: F64) -> F64:
            return np.einsum("tvk,tkd->tvd", weights, values[corners])

        normal, width = at(self.normal), at(self.width[:, None])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        z = grid.at(at(cells))
        p = at(self.position) + width * z[..., None] * normal
        # Mirrored charts are clockwise.
        mirrored = np.linalg.det(cells[corners][:, 1:] - cells[corners][:, :1]) < 0
        order = np.where(mirrored[:, None], [0, 2, 1], [0, 1, 2])[..., None]
        vertices = np.concatenate([p, self._uv(at(self.tile))], -1).astype(np.float32)
        return np.take_along_axis(vertices, order, 1)


def _check(shape: MeshShape, path: Path) -> None:
    """Refuse a shape that cannot be displaced."""
    if shape.uv is None:
        raise InputError(f"'{shape.name}' has no texture coordinates", where=path, hint="unwrap the mesh")
    if not all(np.isfinite(x[shape.faces]).all() for x in (shape.vertices, shape.uv)):
        raise InputError(f"'{shape.name}' has vertices that are not finite", where=path)


def _pieces(places: F64, faces: I64) -> Iterator[tuple[I64, F64]]:
    """Parts of triangles in the half cells of a grid of unit cells: triangles (k,) and the barycentric
    coordinates (k, 3, 3) of the corners of their parts.

    Parameters
    ----------
    places : (n, 2) of the vertices in the grid
    faces : (m, 3)
    """
    corners = places[faces]
    low = np.floor(corners.min(1)).astype(np.int64)
    count = np.floor(corners.max(1)).astype(np.int64) - low + 1
    cells = count.prod(1)
    inverse = np.linalg.inv((corners[:, 1:] - corners[:, :1]).swapaxes(1, 2))
    ends = np.cumsum(cells)
    for start in range(0, int(ends[-1]), _PASS // 2):
        number = np.arange(start, min(start + _PASS // 2, int(ends[-1])))
        face = np.searchsorted(ends, number, side="right")
        inside = number - (ends[face] - cells[face])
        cell = low[face] + np.stack([inside % count[face, 0], inside // count[face, 0]], -1)
        face = np.repeat(face, 2)
        halves = (cell[:, None, None] + _HALVES).reshape(-1, 3, 2)
        others = np.einsum("tij,tvj->tvi", inverse[face], halves - corners[face, :1])
        weights = np.concatenate([1.0 - others.sum(-1, keepdims=True), others], -1)
        touched = (weights.max(1) > 0).all(1)
        face, weights = face[touched], weights[touched]
        whole = (weights >= 0).all((1, 2))
        yield face[whole], weights[whole]
        face, polygons = face[~whole], weights[~whole]
        size = np.abs(np.linalg.det(polygons))
        for k in range(3):
            polygons, kept = _clipped(polygons, k)
            face, size = face[kept], size[kept]
        for k in range(1, polygons.shape[1] - 1):
            part = polygons[:, [0, k, k + 1]]
            good = np.abs(np.linalg.det(part)) > _SLIVER * size
            yield face[good], part[good]


def _clipped(polygons: F64, k: int) -> tuple[F64, NDArray[np.bool_]]:
    """The parts of convex polygons (m, n, 3) where a coordinate is positive, as (m, n + 1, 3) whose last
    corner may be repeated, and which of the polygons have one."""
    m, n, _ = polygons.shape
    following = np.roll(polygons, -1, axis=1)
    here, there = polygons[..., k], following[..., k]
    crosses = (here >= 0) != (there >= 0)
    share = here / np.where(crosses, here - there, 1.0)
    both = np.stack([polygons, polygons + share[..., None] * (following - polygons)], 2).reshape(m, 2 * n, 3)
    keep = np.stack([here >= 0, crosses], 2).reshape(m, 2 * n)
    kept = keep.sum(1)
    order = np.argsort(~keep, axis=1, kind="stable")[:, : n + 1]
    order = np.take_along_axis(order, np.minimum(np.arange(n + 1), np.maximum(kept[:, None] - 1, 0)), 1)
    out = np.take_along_axis(both, order[..., None], 1)
    return out[kept > 0], kept > 0

"""Meshes for ``curved.py``: an object with texture coordinates, smooth, or moved by a tile's heights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Surface:
    """A smooth triangle mesh with texture coordinates, in a ball of radius 1 about the origin.

    Attributes
    ----------
    place, normal : (n, 3)
    uv : (n, 2) in tile widths, v downwards as the rows of images go
    size : (n,) length of a tile width on the surface
    faces : (m, 3)
    """

    place: F64
    normal: F64
    uv: F64
    size: F64
    faces: NDArray[np.int64]


def load_object(file: Path | None, tiles: tuple[float, float]) -> Surface:
    """An object as its file has it, or a square; normals and tile sizes are the same on both sides of seams.

    Parameters
    ----------
    tiles : tiles per unit of its texture coordinates, along both
    """
    if file is not None:
        import trimesh

        mesh = trimesh.load(file, process=False)
        place, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        wide = np.asarray(mesh.visual.uv, np.float64)
    else:
        place, wide, faces = _square(40)
    place = place - 0.5 * (place.min(0) + place.max(0))
    place /= np.linalg.norm(place, axis=1).max()
    uv = wide * (1.0, -1.0) * tiles
    corner, wide = place[faces], uv[faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    a, b = wide[:, 1] - wide[:, 0], wide[:, 2] - wide[:, 0]
    flat = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    area = np.linalg.norm(cross, axis=1)
    _, same = np.unique(np.round(place, 6), axis=0, return_inverse=True)
    same = same.ravel()

    def gathered(per_face: F64) -> F64:
        out = np.zeros((same.max() + 1, *per_face.shape[1:]))
        for k in range(3):
            np.add.at(out, same[faces[:, k]], per_face)
        return out[same]

    normal = gathered(cross)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    size = np.sqrt(gathered(area) / np.maximum(gathered(flat), 1e-20))
    return Surface(place, normal, uv, size, faces)


def _square(n: int) -> tuple[F64, F64, NDArray[np.int64]]:
    """A horizontal square of n x n cells: vertices, texture coordinates, triangles."""
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
    uv = np.stack([i, j], -1) / n
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    right, up = corner + 1, corner + n + 1
    faces = np.concatenate([np.stack([corner, right, up + 1], -1), np.stack([corner, up + 1, up], -1)])
    return np.stack([uv[:, 0], np.zeros(len(uv)), -uv[:, 1]], -1), uv, faces


def points(surface: Surface, face: NDArray[np.int64], weights: F64) -> Surface:
    """Points of triangles, by barycentric coordinates (n, 3), without triangles of their own. They lie on the
    triangles rounded by their vertices' normals (Phong tessellation, Boubekeur and Alexa 2008)."""
    corners = surface.faces[face]

    def mixed(array: F64) -> F64:
        return np.asarray(sum(_times(weights[:, k], array[corners[:, k]]) for k in range(3)))

    place, normal = mixed(surface.place), mixed(surface.normal)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    rounded = np.zeros_like(place)
    for k in range(3):
        at, to = surface.place[corners[:, k]], surface.normal[corners[:, k]]
        onto = place - ((place - at) * to).sum(1, keepdims=True) * to
        rounded += weights[:, k, None] * onto
    # Same points of neighboring triangles are rounded alike, so that no crack opens.
    place = np.round(0.25 * place + 0.75 * rounded, 7)
    return Surface(place, normal, mixed(surface.uv), mixed(surface.size), np.zeros((0, 3), np.int64))


def _times(weight: F64, array: F64) -> F64:
    return weight.reshape(-1, *[1] * (array.ndim - 1)) * array


def refined(surface: Surface, n: int) -> Surface:
    """Every triangle cut into n², and rounded."""
    steps = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)])
    weights = np.concatenate([steps, n - steps.sum(1, keepdims=True)], 1) / n
    number = {tuple(s): k for k, s in enumerate(steps)}
    pattern = []
    for i in range(n):
        for j in range(n - i):
            pattern.append((number[i, j], number[i + 1, j], number[i, j + 1]))
            if i + j < n - 1:
                pattern.append((number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]))
    faces, count = len(surface.faces), len(weights)
    cut = points(surface, np.repeat(np.arange(faces), count), np.tile(weights, (faces, 1)))
    return replace(cut, faces=(count * np.arange(faces)[:, None, None] + np.array(pattern)).reshape(-1, 3))


def displaced(surface: Surface, grid: Any) -> Surface:
    """The tile's own mesh, laid over the object and moved along its normals by the heights.

    Vertices are those of the tile's mesh, so that its triangles are there with all of their slopes: heights
    that are looked up elsewhere give a smoother relief, which shines differently. Along seams and borders of
    the texture coordinates vertices up to a cell outside are moved there, so that nothing gapes.
    """
    rows, columns = grid.z.shape
    cells = surface.uv * (columns, rows / grid.aspect) - 0.5
    chart = _charts(surface)
    keys, face, weights = _vertices(cells[surface.faces], chart[surface.faces[:, 0]])
    out = points(surface, face, weights)
    code = _code(keys)
    corner = [_found(code, code + step) for step in (0, 1 << 24, (1 << 24) + 1, 1)]
    pieces = [np.stack([corner[k] for k in three], -1) for three in ((0, 1, 2), (0, 2, 3))]
    faces = np.concatenate([piece[(piece >= 0).all(1)] for piece in pieces])
    # Texture coordinates may be mirrored.
    a, b, c = (out.place[faces[:, k]] for k in range(3))
    wrong = (np.cross(b - a, c - a) * out.normal[faces[:, 0]]).sum(1) < 0
    faces[wrong] = faces[wrong][:, [0, 2, 1]]
    height = grid.z[keys[:, 1] % rows, keys[:, 2] % columns]
    uv = (keys[:, :0:-1] + 0.5) / (columns, rows / grid.aspect)
    return Surface(out.place + (height * out.size)[:, None] * out.normal, out.normal, uv, out.size, faces)


def _charts(surface: Surface) -> NDArray[np.int64]:
    """Of each vertex the number of the piece of texture coordinates that it belongs to."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    _, same = np.unique(np.round(np.c_[surface.place, surface.uv], 6), axis=0, return_inverse=True)
    a, b, c = same.ravel()[surface.faces].T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    n = int(same.max()) + 1
    _, label = connected_components(coo_array((np.ones(len(ends[0])), ends), shape=(n, n)), directed=False)
    return np.asarray(label[same.ravel()], np.int64)


def _vertices(corner: F64, chart: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64], F64]:
    """Vertices of the tile's mesh that lie in triangles, or at most a cell outside all of a chart's.

    Parameters
    ----------
    corner : (m, 3, 2) of the triangles, in cells (column, row)
    chart : (m,)

    Returns
    -------
    (n, 3) chart, row, column; (n,) triangle; (n, 3) barycentric coordinates in it of the point or, from
    outside, of one on its edge
    """
    low, high = np.floor(corner.min(1)).astype(np.int64), np.ceil(corner.max(1)).astype(np.int64) + 1
    # One more on every side.
    low -= 1
    extent = high + 1 - low
    found = []
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    double = _cross(b - a, c - a)
    lengths = np.stack([np.linalg.norm(x, axis=1) for x in (c - b, a - c, b - a)], 1)
    usable = np.flatnonzero(np.abs(double) > 1e-9)
    ends = np.cumsum(extent[usable].prod(1))
    for part in np.array_split(usable, int(ends[-1] // 4_000_000) + 1):
        many = extent[part].prod(1)
        face = np.repeat(part, many)
        index = np.arange(len(face)) - np.repeat(np.cumsum(many) - many, many)
        at = low[face] + np.stack([index % extent[face, 0], index // extent[face, 0]], 1)
        first = _cross(c[face] - b[face], at - b[face]) / double[face]
        second = _cross(a[face] - c[face], at - c[face]) / double[face]
        weights = np.stack([first, second, 1.0 - first - second], 1)
        depth = (weights * (np.abs(double[face]) / lengths[face].T).T).min(1)
        near = depth >= -1.0
        found.append((at[near], face[near], weights[near], depth[near]))
    at, face, weights, depth = (np.concatenate(x) for x in zip(*found, strict=True))
    keys = np.stack([chart[face], at[:, 1], at[:, 0]], 1)
    code = _code(keys)
    order = np.lexsort((-depth, code))
    new = order[np.diff(code[order], prepend=-1) != 0]
    inside = np.maximum(weights[new], 0.0)
    return keys[new], face[new], inside / inside.sum(1, keepdims=True)


def _code(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number for each (chart, row, column); rows and columns are less than 2²³ from 0."""
    half = 1 << 23
    return (keys[:, 0] << 48) + ((keys[:, 1] + half) << 24) + keys[:, 2] + half


def _found(code: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Places of numbers in a sorted array; -1 for those that it lacks."""
    place = np.minimum(np.searchsorted(code, wanted), len(code) - 1)
    return np.where(code[place] == wanted, place, -1)


def _cross(a: F64, b: F64) -> F64:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])

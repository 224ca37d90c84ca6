"""Polygons → triangles."""

from __future__ import annotations

import math

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
# A corner turns inward if the sine of its angle is below minus this.
_STRAIGHT = 1e-9
# Warning of polygons that have another area than their triangles.
CROSSING = "{:,} polygons cross themselves: their triangles may overlap"


@np.errstate(all="ignore")
def triangulate(points: F64, sizes: I64) -> tuple[I64, I64, int]:
    """Triangles between the corners (c, 3) of polygons, one polygon after the other.

    Convex polygons become fans around their first corner. Concave ones are cut into ears. Polygons of fewer
    than three corners (`sizes`) have no triangles.

    Returns
    -------
    triangles : (m, 3) int64 array, corners of each triangle
    polygon : (m,) int64 array, polygon of each triangle, ascending
    crossing : number of concave polygons that cross themselves
    """
    first, counts = np.cumsum(sizes) - sizes, np.maximum(sizes - 2, 0)
    polygon = np.repeat(np.arange(len(sizes)), counts)
    step = np.arange(len(polygon)) - (np.cumsum(counts) - counts)[polygon]
    triangles = np.stack([np.zeros_like(step), step + 1, step + 2], axis=1) + first[polygon][:, None]
    large = np.flatnonzero(sizes > 3)
    normals, concave = _normals(points, first[large], sizes[large])
    fans = ~np.isin(polygon, large[concave])
    parts, of, crossing = [triangles[fans]], [polygon[fans]], 0
    for number, normal in zip(large[concave], normals[concave], strict=True):
        corners = _flattened(points[first[number] : first[number] + sizes[number]], normal)
        ears = mapbox_earcut.triangulate_float64(corners, np.array([len(corners)], np.uint32)).reshape(-1, 3)
        whole, cut = _areas(corners), np.abs(_areas(corners[ears])).sum()
        # Slivers have no area.
        crossing += not math.isclose(cut, whole, rel_tol=1e-6, abs_tol=1e-12)
        parts.append(first[number] + ears.astype(np.int64))
        of.append(np.full(len(ears), number))
    every = np.concatenate(of)
    order = np.argsort(every, kind="stable")
    return np.concatenate(parts)[order], every[order], crossing


def _normals(points: F64, first: I64, sizes: I64) -> tuple[F64, NDArray[np.bool_]]:
    """Normals (p, 3) of polygons, and which have a corner that turns inward."""
    if not len(sizes):
        return np.zeros((0, 3)), np.zeros(0, bool)
    polygon = np.repeat(np.arange(len(sizes)), sizes)
    begin = np.cumsum(sizes) - sizes
    corner = np.arange(len(polygon)) - begin[polygon]
    here, onward, back = (points[first[polygon] + (corner + by) % sizes[polygon]] for by in (0, 1, -1))
    origin = points[first][polygon]
    normals = np.add.reduceat(np.cross(here - origin, onward - origin), begin, axis=0)
    before, after = here - back, onward - here
    turn = (np.cross(before, after) * normals[polygon]).sum(axis=1)
    scale = np.prod([np.linalg.norm(v, axis=1) for v in (before, after, normals[polygon])], axis=0)
    return normals, np.logical_or.reduceat(turn < -_STRAIGHT * scale, begin)


def _flattened(corners: F64, normal: F64) -> F64:
    """Corners (n, 2) in the plane across a normal, counterclockwise, at most 1 from the first."""
    axis = int(np.argmin(np.abs(normal)))
    along = np.cross(normal, np.eye(3)[axis])
    across = np.cross(normal, along)
    centered = (corners - corners[0]) / np.linalg.norm(corners - corners[0], axis=1).max()
    return np.stack([centered @ (v / np.linalg.norm(v)) for v in (along, across)], axis=1)


def _areas(p: F64) -> F64:
    """Areas (...) of polygons (..., n, 2), positive if they are counterclockwise."""
    x, y = p[..., 0], p[..., 1]
    return np.asarray(0.5 * (x * np.roll(y, -1, axis=-1) - y * np.roll(x, -1, axis=-1)).sum(axis=-1))

"""Polygons → triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
# Corners of a concave polygon; the time to clip its ears grows with the square of their number.
MOST_CORNERS = 5000
# A corner turns inward if the sine of its angle is below minus this.
_STRAIGHT = 1e-9
# Twice the area of a triangle that counts as 0, of a polygon that is about 1 long.
_FLAT = 1e-12
# Warning of polygons that are not cut.
UNCUT = "{:,} polygons cross themselves: their triangles may overlap"


@np.errstate(all="ignore")
def triangulate(points: F64, sizes: I64) -> tuple[I64, I64, int]:
    """Triangles between the corners of polygons.

    Convex polygons become fans around their first corner. Concave ones are cut into ears.

    Parameters
    ----------
    points : (c, 3) float64 array
        Corners of all polygons, one polygon after the other.
    sizes : (p,) int64 array
        Number of corners of each polygon; those of fewer than three have no triangles.

    Returns
    -------
    triangles : (m, 3) int64 array
        Corners of each triangle, in the order of the polygon.
    polygon : (m,) int64 array
        Polygon of each triangle, ascending.
    uncut : int
        Number of concave polygons that are fans too, because they cross themselves or have more than
        ``MOST_CORNERS`` corners.
    """
    first, counts = np.cumsum(sizes) - sizes, np.maximum(sizes - 2, 0)
    polygon = np.repeat(np.arange(len(sizes)), counts)
    start = np.cumsum(counts) - counts
    step = np.arange(len(polygon)) - start[polygon]
    triangles = np.stack([np.zeros_like(step), step + 1, step + 2], axis=1)
    large = np.flatnonzero(sizes > 3)
    normals, inward = _turns(points, first[large], sizes[large])
    number_inward = np.bincount(inward[0], minlength=len(large))
    # The fan of a quadrilateral around its only inward corner is right.
    one = (number_inward == 1) & (sizes[large] == 4)
    turned = one[inward[0]]
    quads = start[large[inward[0][turned]]]
    for row in (quads, quads + 1):
        triangles[row] = (triangles[row] + inward[1][turned][:, None]) % 4
    uncut = 0
    for which in np.flatnonzero((number_inward > 0) & ~one):
        number = large[which]
        corners = points[first[number] : first[number] + sizes[number]]
        ears = _ears(_flattened(corners, normals[which])) if sizes[number] <= MOST_CORNERS else None
        if ears is None:
            uncut += 1
        else:
            triangles[start[number] : start[number] + counts[number]] = ears
    return triangles + first[polygon][:, None], polygon, uncut


def _turns(points: F64, first: I64, sizes: I64) -> tuple[F64, tuple[I64, I64]]:
    """Normals (p, 3) of polygons, and (polygon, corner) of all corners that turn inward."""
    if not len(sizes):
        return np.zeros((0, 3)), (np.zeros(0, np.int64), np.zeros(0, np.int64))
    polygon = np.repeat(np.arange(len(sizes)), sizes)
    begin = np.cumsum(sizes) - sizes
    corner = np.arange(len(polygon)) - begin[polygon]
    here, onward, back = (points[first[polygon] + (corner + by) % sizes[polygon]] for by in (0, 1, -1))
    origin = points[first][polygon]
    normals = np.add.reduceat(np.cross(here - origin, onward - origin), begin, axis=0)
    before, after = here - back, onward - here
    turn = (np.cross(before, after) * normals[polygon]).sum(axis=1)
    scale = np.prod([np.linalg.norm(v, axis=1) for v in (before, after, normals[polygon])], axis=0)
    inward = turn < -_STRAIGHT * scale
    return normals, (polygon[inward], corner[inward])


def _flattened(corners: F64, normal: F64) -> F64:
    """Corners (n, 2) in the plane across a normal, counterclockwise, at most 1 from the first."""
    axis = int(np.argmin(np.abs(normal)))
    along = np.cross(normal, np.eye(3)[axis])
    across = np.cross(normal, along)
    centered = (corners - corners[0]) / np.linalg.norm(corners - corners[0], axis=1).max()
    return np.stack([centered @ (v / np.linalg.norm(v)) for v in (along, across)], axis=1)


def _ears(p: F64) -> I64 | None:
    """Triangles (n - 2, 3) of a simple polygon (n, 2); None where it crosses itself."""
    left = np.arange(len(p))
    out = []
    while len(left) > 3:
        here = p[left]
        back, onward = np.roll(here, 1, axis=0), np.roll(here, -1, axis=0)
        turn = _cross(here - back, onward - here)
        # Corners on a straight line come last: their triangles have no area.
        ears = [*np.flatnonzero(turn > _FLAT), *np.flatnonzero(np.abs(turn) <= _FLAT)]
        inward = here[turn <= _FLAT]
        ear = next((e for e in ears if not _within(inward, back[e], here[e], onward[e])), None)
        if ear is None:
            return None
        out.append(left[[ear - 1, ear, (ear + 1) % len(left)]])
        left = np.delete(left, ear)
    a, b, c = p[left]
    return None if _cross(b - a, c - b) < -_FLAT else np.array([*out, left])


def _within(points: F64, a: F64, b: F64, c: F64) -> bool:
    """Whether a triangle, its border included, has any of the points, other than its own corners."""
    inside = np.all([_cross(v - u, points - u) >= -_FLAT for u, v in ((a, b), (b, c), (c, a))], axis=0)
    own = np.any([(points == corner).all(axis=1) for corner in (a, b, c)], axis=0)
    return bool((inside & ~own).any())


def _cross(a: F64, b: F64) -> F64:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])

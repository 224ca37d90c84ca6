"""Polygons → triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
_Point = tuple[float, float]
# Corners of a concave polygon; the time to clip its ears grows with the square of their number.
MOST_CORNERS = 2000
# A corner turns inward if the sine of its angle is below minus this.
_STRAIGHT = 1e-9
# Twice the area of a triangle that counts as 0, of a polygon that is about 1 long.
_FLAT = 1e-12
# Warning of polygons that are not cut.
UNCUT = (
    f"{{:,}} polygons cross themselves or are concave with over {MOST_CORNERS:,} corners: they may overlap"
)


@np.errstate(all="ignore")
def triangulate(points: F64, sizes: I64) -> tuple[I64, I64, int]:
    """Triangles between the corners (c, 3) of polygons, one polygon after the other.

    Convex polygons become fans around their first corner. Concave ones are cut into ears. Polygons of fewer
    than three corners (`sizes`) have no triangles.

    Returns
    -------
    triangles : (m, 3) int64 array, corners of each triangle, in the order of the polygon
    polygon : (m,) int64 array, polygon of each triangle, ascending
    uncut : number of concave polygons that are fans too, because they cross themselves or have more than
        ``MOST_CORNERS`` corners
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
    # Polygons are small and many: Python's numbers are faster than arrays.
    points: list[_Point] = [(x, y) for x, y in p.tolist()]
    left, out = list(range(len(points))), []

    def around(k: int) -> tuple[int, int, int]:
        return left[k - 1], left[k], left[(k + 1) % len(left)]

    turns = {left[k]: _turn(*(points[i] for i in around(k))) for k in range(len(left))}
    while len(left) > 3:
        inward = [points[i] for i in left if turns[i] <= _FLAT]
        # Corners on a straight line come last: their triangles have no area.
        ears = [k for k, i in enumerate(left) if turns[i] > _FLAT]
        ears += [k for k, i in enumerate(left) if abs(turns[i]) <= _FLAT]
        ear = next((k for k in ears if not _within(inward, *(points[i] for i in around(k)))), None)
        if ear is None:
            return None
        out.append(around(ear))
        del left[ear]
        for k in (ear - 1, ear % len(left)):
            turns[left[k]] = _turn(*(points[i] for i in around(k)))
    return None if turns[left[1]] < -_FLAT else np.array([*out, tuple(left)])


def _within(points: list[_Point], a: _Point, b: _Point, c: _Point) -> bool:
    """Whether a triangle, its border included, has any of the points, other than its own corners."""
    return any(
        _turn(a, b, q) >= -_FLAT and _turn(b, c, q) >= -_FLAT and _turn(c, a, q) >= -_FLAT
        for q in points
        if q not in (a, b, c)
    )


def _turn(a: _Point, b: _Point, c: _Point) -> float:
    """Twice the area of a triangle; positive if it turns to the left."""
    return (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])

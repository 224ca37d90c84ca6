"""Which axis of a mesh seems to point up, where its format does not say it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# A sheet is thinner than this part of its shorter side.
_THIN = 0.5


def y_seems_up(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> bool:
    """Whether triangles look like a sheet that lies in the plane of x and z.

    It is thin along y, and most of its area faces along y rather than z.

    Parameters
    ----------
    vertices : (n, 3) float64 array
        Positions in the axes of the file.
    faces : (m, 3) int64 array
        Vertices of each triangle.
    """
    corners = vertices[faces]
    along_x, along_y, along_z = np.ptp(corners.reshape(-1, 3), axis=0)
    if along_y >= _THIN * min(along_x, along_z):
        return False
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _, facing_y, facing_z = np.abs(normals).sum(axis=0)
    return bool(facing_y > facing_z)

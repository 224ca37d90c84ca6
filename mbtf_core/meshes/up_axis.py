"""Which axis of a mesh seems to point up."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

# A sheet is thinner than this part of its shorter side.
_THIN = 0.5


def seems_up(axis: Literal["y", "z"], vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> bool:
    """Whether triangles look like a sheet that lies in the plane of x and the other axis.

    It is thin along the axis, and most of its area faces along it rather than along the other one.

    Parameters
    ----------
    axis : {"y", "z"}, the axis in question
    vertices : (n, 3), positions in the axes of the file
    faces : (m, 3), vertices of each triangle
    """
    corners = vertices[faces]
    up, other = (1, 2) if axis == "y" else (2, 1)
    extent = np.ptp(corners.reshape(-1, 3), axis=0)
    if extent[up] >= _THIN * min(extent[0], extent[other]):
        return False
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = np.abs(normals).sum(axis=0)
    return bool(facing[up] > facing[other])

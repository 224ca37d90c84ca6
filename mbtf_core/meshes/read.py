"""Files of triangles, whatever their format, and which of their axes points up."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.meshes.content import MeshContent
from mbtf_core.meshes.gltf import read_gltf
from mbtf_core.meshes.obj import read_obj
from mbtf_core.meshes.ply import read_ply

_READERS: dict[str, Callable[[Path], MeshContent]] = {
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".ply": read_ply,
    ".obj": read_obj,
}
MESH_FILES = tuple(_READERS)
# A sheet is thinner than this part of its shorter side.
_THIN = 0.5


def read_mesh_content(path: Path) -> MeshContent:
    """Read a file of triangles whose suffix is among ``MESH_FILES``: at least one shape, whose vertices may
    not be finite. An InputError where the format is not read, the file is missing or damaged, or it has no
    triangles."""
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"'{path.suffix}' is not a mesh", where=path, hint=f"give {', '.join(MESH_FILES)}")
    content = reader(path)
    if not content.shapes:
        raise InputError("has no triangles", where=path)
    return content


def seems_up(axis: Literal["y", "z"], vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> bool:
    """Whether triangles look like a sheet that lies in the plane of x and the other axis: it is thin along
    the axis, and most of its area faces along it rather than along the other one.

    `vertices` (n, 3) are in the axes of the file, `faces` (m, 3) the vertices of each triangle.
    """
    corners = vertices[faces]
    up, other = (1, 2) if axis == "y" else (2, 1)
    extent = np.ptp(corners.reshape(-1, 3), axis=0)
    if extent[up] >= _THIN * min(extent[0], extent[other]):
        return False
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = np.abs(normals).sum(axis=0)
    return bool(facing[up] > facing[other])

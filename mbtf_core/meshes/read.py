"""Files of triangles, whatever their format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

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


def read_mesh_content(path: Path) -> MeshContent:
    """Read a file of triangles.

    Parameters
    ----------
    path : a file whose suffix is among ``MESH_FILES``

    Returns
    -------
    MeshContent
        At least one shape; vertices may not be finite.

    Raises
    ------
    InputError : the format is not read, the file is missing or damaged, or it has no triangles
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"'{path.suffix}' is not a mesh", where=path, hint=f"give {', '.join(MESH_FILES)}")
    content = reader(path)
    if not content.shapes:
        raise InputError("has no triangles", where=path)
    return content

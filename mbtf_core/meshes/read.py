"""Files of triangles by their suffix."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mbtf_core.errors import InputError, reason
from mbtf_core.meshes.content import MeshContent, MeshShape
from mbtf_core.meshes.obj import read_obj
from mbtf_core.meshes.ply import read_ply
from mbtf_core.paths import refuse_special, suggest_path

MESH_FILES = (".glb", ".gltf", ".ply", ".obj")


def read_mesh_content(path: Path) -> MeshContent:
    """Read a file of triangles."""
    suffix = path.suffix.lower()
    if suffix not in MESH_FILES:
        raise InputError(f"'{path.suffix}' is not a mesh", where=path, hint=f"give {', '.join(MESH_FILES)}")
    refuse_special(path)
    if not path.is_file():
        raise InputError("no such file", where=path, hint=suggest_path(path))
    if suffix == ".obj":
        return read_obj(path)
    if suffix == ".ply":
        return read_ply(path)
    return _gltf(path)


def _gltf(path: Path) -> MeshContent:
    """Geometry of a glTF file."""
    import trimesh

    try:
        meshes = trimesh.load_scene(path, process=False).dump()
    except Exception as error:  # whatever its readers raise
        raise InputError(f"cannot be read as a mesh ({reason(error)})", where=path) from None
    shapes = []
    for mesh in meshes:
        uv = getattr(mesh.visual, "uv", None)
        normals = np.asarray(mesh.vertex_normals, np.float64)
        name, faces = mesh.metadata.get("name", "mesh"), np.asarray(mesh.faces, np.int64)
        uv = None if uv is None else np.asarray(uv, np.float64)
        shapes.append(MeshShape(name, np.asarray(mesh.vertices, np.float64), faces, uv, normals=normals))
    return MeshContent(shapes, up="y")

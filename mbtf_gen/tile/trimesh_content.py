"""OBJ and PLY read by trimesh, until :mod:`mbtf_core.meshes` has readers of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import InputError, reason
from mbtf_core.meshes.content import F64, MeshContent, MeshShape, Texture

BY_TRIMESH = (".obj", ".ply")


def read_by_trimesh(path: Path) -> MeshContent:
    """Content of a file."""
    import trimesh

    if not path.is_file():
        raise InputError("no such file", where=path)
    try:
        shapes = [(s.metadata.get("name", "mesh"), s) for s in trimesh.load_scene(path, process=False).dump()]
    except Exception as error:  # whatever its readers raise
        raise InputError(f"cannot be read as a mesh ({reason(error)})", where=path) from None
    found = [_shape(str(name), shape) for name, shape in shapes if len(getattr(shape, "faces", ()))]
    if not found:
        raise InputError("has no triangles", where=path)
    names = [
        line.split()[1].decode() for line in path.read_bytes().splitlines() if line.startswith(b"mtllib ")
    ]
    return MeshContent(found, {name: path.parent / name for name in names if (path.parent / name).is_file()})


def _shape(name: str, shape: Any) -> MeshShape:
    material, uv = getattr(shape.visual, "material", None), getattr(shape.visual, "uv", None)
    image, diffuse = getattr(material, "image", None), getattr(material, "diffuse", None)
    values: dict[str, Any] = {}
    if image is not None:
        pixels = srgb_to_linear(np.asarray(image.convert("RGB"), np.float32) / 255.0)
        values["base_color"] = (Texture(pixels.astype(np.float32)), np.ones(3))
    elif diffuse is not None:
        values["base_color"] = srgb_to_linear(_shares(diffuse)[:3])
    return MeshShape(
        name,
        np.asarray(shape.vertices, np.float64),
        np.asarray(shape.faces, np.int64),
        None if uv is None else np.asarray(uv, np.float64),
        None,
        values,
    )


def _shares(color: Any) -> F64:
    array = np.asarray(color)
    return np.clip(array.astype(np.float64) / (255.0 if array.dtype.kind in "iu" else 1.0), 0.0, 1.0)

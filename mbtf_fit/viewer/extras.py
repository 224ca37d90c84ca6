"""What a page shows besides materials: a mesh, an environment, reference pictures, a poster."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from mbtf_core.color import ALBEDO_EXPOSURE, to_display
from mbtf_core.directions import from_angles
from mbtf_core.errors import InputError
from mbtf_core.images.environment import read_environment
from mbtf_core.images.resample import shrink
from mbtf_core.meshes.content import joined, triangle_areas
from mbtf_core.meshes.read import read_mesh_content
from mbtf_core.pictures import Camera, read_references
from mbtf_core.units import tiles_text
from mbtf_fit.material.material import Material
from mbtf_fit.viewer.page import encode
from mbtf_fit.viewer.textures import pack

F64 = NDArray[np.float64]
# Triangles of a mesh in a page, at most.
MOST_TRIANGLES = 200_000
# Rows of an environment, and pixels along the longer side of a reference picture, in a page.
_ENVIRONMENT_ROWS, _PICTURE_SIZE = 64, 512
# Rows and columns of the poster.
_POSTER = (640, 640)


def mesh_content(path: Path) -> dict[str, Any]:
    """A mesh with texture coordinates (:func:`read_shape`) as JSON of a page."""
    arrays, faces, unit = read_shape(path)
    return {
        "name": path.stem,
        **{name: encode(array.astype(np.float32)) for name, array in arrays.items()},
        "indices": encode(faces.astype(np.uint32)),
        "unit": unit,
    }


def environment_content(path: Path) -> dict[str, Any]:
    """A picture of the whole sphere (:func:`~mbtf_core.images.environment.read_environment`), as JSON."""
    pixels = read_environment(path, _ENVIRONMENT_ROWS)
    return {"name": path.stem, "shape": list(pixels.shape[:2]), "data": encode(pixels)}


def picture_content(
    name: str, value: NDArray[np.float32], camera: Camera, light: NDArray[np.floating[Any]]
) -> dict[str, Any]:
    """A path-traced picture of the plane, at most 512 pixels along each side, as JSON.

    Parameters
    ----------
    name : shown in the page
    value : (rows, columns, 3) array of M in 1/sr
    camera : that of the picture
    light : direction (3,) towards the light
    """
    small = shrink(value, -(-max(value.shape[:2]) // _PICTURE_SIZE))
    return {
        "name": name,
        "camera": {
            "elevation": camera.elevation,
            "azimuth": camera.azimuth,
            "tiles_across": camera.tiles_across,
            "target": list(camera.target),
            "field_of_view": camera.field_of_view,
        },
        "light": [float(x) for x in light],
        # Square roots need fewer bits.
        "roots": pack([np.sqrt(np.maximum(small, 0.0)).astype(np.float32)], bits=16).description,
    }


def pictures_content(folder: Path) -> list[dict[str, Any]]:
    """Pictures of ``mbtf-gen reference`` (:func:`~mbtf_core.pictures.read_references`), as JSON."""
    return [
        picture_content(f"path-traced, {tiles_text(camera.tiles_across)} across", value, camera, light)
        for value, camera, light in read_references(folder)
    ]


def poster(material: Material) -> str:
    """The first view of a page as a ``data:`` URI, shown while the browser compiles the shaders.

    Camera, light and exposure are ``FIRST`` of ``page/state.js``; the light has irradiance 1 on the plane.
    """
    aspect = material.lattice.aspect
    q = Camera(50, -90, 3, rows=_POSTER[0], columns=_POSTER[1]).queries(from_angles(45, -30), aspect).flat()
    value = material.evaluate(q.u, q.sigma, q.omega_i, q.omega_o).reshape(*_POSTER, 3)
    stream = io.BytesIO()
    Image.fromarray(to_display(value, ALBEDO_EXPOSURE)).save(stream, "jpeg", quality=85)
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode()}"


def read_shape(path: Path) -> tuple[dict[str, F64], NDArray[np.int64], float]:
    """A mesh with texture coordinates, centered, of radius 1, with z up.

    Parameters
    ----------
    path : OBJ, PLY, glTF or GLB file, with y up

    Returns
    -------
    arrays : ``positions`` and ``normals`` (n, 3); ``tangents`` (n, 4), unit vectors along u and the hand of
        their frames (:func:`tangents`); ``uvs`` (n, 2)
    faces : (m, 3)
    unit : factor on the positions that gives one texture unit the length 1 on average

    Raises
    ------
    InputError : the file cannot be read, a part has no texture coordinates, or there are too many triangles
    """
    shapes = read_mesh_content(path).shapes
    counts = [len(shape.vertices) for shape in shapes]
    vertices, faces = joined(shapes)
    if not len(faces) or not np.isfinite(vertices).all():
        raise InputError("has no triangles of finite vertices", where=path)
    bare = [shape.name for shape in shapes if shape.uv is None]
    if bare:
        raise InputError(
            f"'{bare[0]}' has no texture coordinates, which place the material",
            where=path,
            hint="unwrap that part, or leave it out" if len(bare) < len(shapes) else "unwrap the mesh first",
        )
    uv = np.concatenate([shape.uv for shape in shapes if shape.uv is not None])
    if len(faces) > MOST_TRIANGLES:
        raise InputError(
            f"has {len(faces):,} triangles, more than {MOST_TRIANGLES:,}", where=path, hint="simplify it"
        )
    uv = np.nan_to_num(uv)
    import trimesh

    # Vertices of a part at one position and one place of the texture share their frame.
    part = np.repeat(np.arange(len(shapes)), counts)
    places, same = np.unique(np.column_stack([vertices, uv, part]), axis=0, return_inverse=True)
    welded = trimesh.Trimesh(places[:, :3], same[faces], process=False)
    smooth = np.split(welded.vertex_normals[same], np.cumsum(counts[:-1]))
    given = [shape.normals for shape in shapes]
    normals = np.concatenate([n if own is None else own for own, n in zip(given, smooth, strict=True)])
    center = (vertices.min(0) + vertices.max(0)) / 2
    radius = float(np.linalg.norm(vertices - center, axis=1).max())
    # Files have y up.
    vertices = (vertices - center)[:, [0, 2, 1]] * (1, -1, 1) / (radius or 1.0)
    normals = _unit(normals[:, [0, 2, 1]] * (1, -1, 1))
    area, textured = (abs(triangle_areas(x, faces)).sum() for x in (vertices, uv))
    if textured <= 0:
        raise InputError("has texture coordinates without an area", where=path, hint="unwrap the mesh first")
    unit = float(np.sqrt(textured / area)) if area > 0 else 1.0
    arrays = {
        "positions": vertices,
        "normals": normals,
        "tangents": tangents(vertices, normals, uv, faces, same),
        "uvs": uv,
    }
    return arrays, faces, unit


def _unit(vectors: F64, otherwise: ArrayLike = (0.0, 0.0, 1.0)) -> F64:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1.0), otherwise)


def tangents(vertices: F64, normals: F64, uv: F64, faces: NDArray[np.int64], same: NDArray[np.int64]) -> F64:
    """Unit tangents ∂p/∂u at vertices, means over those of the `same` number, and the hand of their frames:
    (n, 4).

    The hand is 1 where the normal, ∂p/∂u and ∂p/∂v form a right-handed frame (t × b = n), otherwise -1.
    """
    a, b = (vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))
    s, t = (uv[faces[:, k]] - uv[faces[:, 0]] for k in (1, 2))
    area = (s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0])[:, None]
    # Weighted by the area in the texture.
    sign = np.sign(area)
    along_u = sign * (a * t[:, 1:] - b * s[:, 1:])
    along_v = sign * (b * s[:, :1] - a * t[:, :1])
    sums = np.zeros((2, *vertices.shape))
    for k in range(3):
        np.add.at(sums[0], same[faces[:, k]], along_u)
        np.add.at(sums[1], same[faces[:, k]], along_v)
    sums = sums[:, same]
    n = _unit(normals)
    tangent = sums[0] - n * (n * sums[0]).sum(1, keepdims=True)
    some = np.linalg.norm(tangent, axis=1) > 1e-12
    other = np.cross(n, np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    tangent = _unit(np.where(some[:, None], tangent, other))
    hand = np.where((np.cross(n, tangent) * sums[1]).sum(1) < 0, -1.0, 1.0)
    return np.concatenate([tangent, hand[:, None]], 1)

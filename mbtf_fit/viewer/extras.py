"""What a page shows besides materials: a mesh, a picture of the surroundings, reference pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.atomic import read_json
from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import InputError, reason
from mbtf_core.suggest import suggest_path
from mbtf_fit.viewer.content import encode
from mbtf_fit.viewer.textures import pack
from mbtf_gen.dataset.shard_io import read_exr
from mbtf_gen.images.read import read_image
from mbtf_gen.images.resample import resample
from mbtf_gen.meshes.mesh_file import MESH_FILES
from mbtf_gen.pictures.camera import Camera
from mbtf_gen.pictures.folder import RECORD_NAME
from mbtf_gen.pictures.reference import read_value

F64 = NDArray[np.float64]
# Triangles of a mesh, and rows of an environment, that a page holds.
MOST_TRIANGLES = 200_000
_ENVIRONMENT_ROWS = 64
# Pixels along the longer side of a reference picture in a page.
_PICTURE_SIZE = 512


def mesh_content(path: Path) -> dict[str, Any]:
    """A mesh with texture coordinates, centered, of radius 1.

    Parameters
    ----------
    path : Path
        OBJ, PLY, glTF, GLB or STL file.

    Returns
    -------
    dict
        ``name``; ``positions``, ``normals``, ``tangents`` (with the frame's hand), ``uvs``, ``indices`` in
        base64; ``unit``, the factor on the positions that gives one texture unit the length 1 on average.

    Raises
    ------
    InputError
        The file cannot be read, has no texture coordinates, or too many triangles.
    """
    import trimesh

    if path.suffix.lower() not in MESH_FILES:
        raise InputError(f"'{path.suffix}' is not a mesh", where=path, hint=f"give {', '.join(MESH_FILES)}")
    if not path.is_file():
        raise InputError("no such file", where=path, hint=suggest_path(path))
    try:
        mesh = trimesh.load_mesh(path)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        normals = np.asarray(mesh.vertex_normals, np.float64)
        uv = getattr(mesh.visual, "uv", None)
    except Exception as error:  # whatever its readers raise
        raise InputError(f"cannot be read as a mesh ({reason(error)})", where=path) from None
    if not len(faces) or not np.isfinite(vertices).all():
        raise InputError("has no triangles of finite vertices", where=path)
    if uv is None or len(uv) != len(vertices):
        raise InputError(
            "has no texture coordinates, which place the material", where=path, hint="unwrap the mesh first"
        )
    if len(faces) > MOST_TRIANGLES:
        raise InputError(
            f"has {len(faces):,} triangles; a page holds {MOST_TRIANGLES:,}", where=path, hint="simplify it"
        )
    uv = np.nan_to_num(np.asarray(uv, np.float64))
    center = (vertices.min(0) + vertices.max(0)) / 2
    radius = float(np.linalg.norm(vertices - center, axis=1).max())
    # Files have y up.
    vertices = (vertices - center)[:, [0, 2, 1]] * (1, -1, 1) / (radius or 1.0)
    normals = normals[:, [0, 2, 1]] * (1, -1, 1)
    area, textured = _areas(vertices, uv, faces)
    if textured <= 0:
        raise InputError("has texture coordinates without an area", where=path, hint="unwrap the mesh first")
    return {
        "name": path.stem,
        "positions": encode(vertices.astype(np.float32)),
        "normals": encode(_unit(normals).astype(np.float32)),
        "tangents": encode(tangents(vertices, normals, uv, faces).astype(np.float32)),
        "uvs": encode(uv.astype(np.float32)),
        "indices": encode(faces.astype(np.uint32)),
        "unit": float(np.sqrt(textured / area)) if area > 0 else 1.0,
    }


def _unit(vectors: F64) -> F64:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1.0), (0.0, 0.0, 1.0))


def _areas(vertices: F64, uv: F64, faces: NDArray[np.int64]) -> tuple[float, float]:
    """Area of all triangles in space, and in the texture."""
    a, b = (vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))
    s, t = (uv[faces[:, k]] - uv[faces[:, 0]] for k in (1, 2))
    flat = np.abs(s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0])
    return float(np.linalg.norm(np.cross(a, b), axis=1).sum() / 2), float(flat.sum() / 2)


def tangents(vertices: F64, normals: F64, uv: F64, faces: NDArray[np.int64]) -> F64:
    """Unit tangents ∂p/∂u at vertices, and the hand of their frames: (n, 4).

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
        np.add.at(sums[0], faces[:, k], along_u)
        np.add.at(sums[1], faces[:, k], along_v)
    n = _unit(normals)
    tangent = sums[0] - n * (n * sums[0]).sum(1, keepdims=True)
    some = np.linalg.norm(tangent, axis=1) > 1e-12
    other = np.cross(n, np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    tangent = _unit(np.where(some[:, None], tangent, other))
    hand = np.where((np.cross(n, tangent) * sums[1]).sum(1) < 0, -1.0, 1.0)
    return np.concatenate([tangent, hand[:, None]], 1)


def environment_content(path: Path) -> dict[str, Any]:
    """A picture of the whole sphere, reduced to 64 rows: rows by latitude, the top one at z.

    Parameters
    ----------
    path : Path
        EXR, HDR, PNG, JPG, TIFF or npy file; 8-bit colors are sRGB.

    Returns
    -------
    dict
        ``name``, ``shape`` (rows, columns), and ``data``, linear RGB in base64.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    pixels = _radiance(path) if path.suffix.lower() == ".hdr" else _pixels(path)
    rows = min(_ENVIRONMENT_ROWS, pixels.shape[0])
    columns = max(1, round(rows * pixels.shape[1] / pixels.shape[0]))
    small = np.asarray(resample(pixels, rows, min(columns, pixels.shape[1])), np.float32)
    return {"name": path.stem, "shape": list(small.shape[:2]), "data": encode(np.maximum(small, 0.0))}


def _pixels(path: Path) -> NDArray[np.float64]:
    image = read_image(path)
    pixels = np.asarray(image.pixels, np.float64)
    pixels = pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, 2)
    return np.asarray(pixels if image.bits is None else srgb_to_linear(pixels), np.float64)


def _radiance(path: Path) -> NDArray[np.float64]:
    """A Radiance picture (RGBE)."""
    import imagecodecs

    if not path.is_file():
        raise InputError("no such file", where=path, hint=suggest_path(path))
    try:
        pixels = np.asarray(imagecodecs.rgbe_decode(path.read_bytes()), np.float64)
    except Exception as error:  # whatever the decoder raises
        raise InputError(f"cannot be read as a Radiance picture ({reason(error)})", where=path) from None
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not np.isfinite(pixels).all():
        raise InputError("is not a picture of three colors", where=path)
    return pixels


def picture_content(
    name: str, value: NDArray[np.float32], camera: Camera, light: NDArray[np.float64]
) -> dict[str, Any]:
    """A path-traced picture of the plane, at most 512 pixels along each side.

    Parameters
    ----------
    name : str
        Shown in the page.
    value : (rows, columns, 3) array
        M in 1/sr.
    camera : Camera
        That of the picture.
    light : (3,) array
        Direction towards the light.

    Returns
    -------
    dict
    """
    rows, columns = value.shape[:2]
    shrink = max(1, -(-max(rows, columns) // _PICTURE_SIZE))
    small = resample(value, rows // shrink, columns // shrink) if shrink > 1 else value
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
    """Pictures of ``mbtf-gen reference``, as :func:`picture_content`.

    Parameters
    ----------
    folder : Path
        Output folder of the command.

    Returns
    -------
    list of dict

    Raises
    ------
    InputError
        The folder has no such pictures.
    """
    record = folder / RECORD_NAME
    if not record.is_file():
        raise InputError(
            "holds no pictures of mbtf-gen reference", where=folder, hint=suggest_path(folder, Path.is_dir)
        )
    known = read_json(record)
    options = known.get("depends", {}).get("reference", {})
    if known.get("kind") != "reference" or not {"view", "light", "tiles_across"} <= set(options):
        raise InputError("holds no pictures of mbtf-gen reference", where=folder)
    out = []
    for across in options["tiles_across"]:
        name = next((n for n in known["pictures"] if n.endswith(f"-tiles{across:g}")), None)
        if name is None:
            continue
        path = folder / f"{name}.exr"
        light = read_exr(path, ("omega_i",))["omega_i"].reshape(-1, 3)[0]
        camera = Camera(options["view"]["elevation"], options["view"]["azimuth"], across)
        out.append(picture_content(f"path-traced, {across:g} tiles across", read_value(path), camera, light))
    if not out:
        raise InputError("holds no finished picture", where=folder, hint="run mbtf-gen reference again")
    return out

"""What a page shows besides materials: a mesh, a picture of the surroundings, reference pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.images.environment import read_environment
from mbtf_core.images.resample import resample
from mbtf_core.pictures import Camera, read_references
from mbtf_fit.viewer.content import encode
from mbtf_fit.viewer.shape import read_shape
from mbtf_fit.viewer.textures import pack

# Rows of an environment, and pixels along the longer side of a reference picture, in a page.
_ENVIRONMENT_ROWS, _PICTURE_SIZE = 64, 512


def mesh_content(path: Path) -> dict[str, Any]:
    """A mesh with texture coordinates (:func:`~mbtf_fit.viewer.shape.read_shape`) as JSON of a page."""
    shape = read_shape(path)
    arrays = {
        "positions": shape.positions,
        "normals": shape.normals,
        "tangents": shape.tangents,
        "uvs": shape.uv,
    }
    return {
        "name": path.stem,
        **{name: encode(array.astype(np.float32)) for name, array in arrays.items()},
        "indices": encode(shape.faces.astype(np.uint32)),
        "unit": shape.unit,
    }


def environment_content(path: Path) -> dict[str, Any]:
    """A picture of the whole sphere (:func:`~mbtf_core.images.environment.read_environment`), as JSON."""
    pixels = read_environment(path, _ENVIRONMENT_ROWS)
    return {"name": path.stem, "shape": list(pixels.shape[:2]), "data": encode(pixels)}


def picture_content(
    name: str, value: NDArray[np.float32], camera: Camera, light: NDArray[np.floating[Any]]
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
    """Pictures of ``mbtf-gen reference`` (:func:`~mbtf_core.pictures.read_references`), as JSON."""
    return [
        picture_content(f"path-traced, {tiles_text(camera.tiles_across)} across", value, camera, light)
        for value, camera, light in read_references(folder)
    ]


def tiles_text(count: float) -> str:
    """A number of tiles in words."""
    return "1 tile" if count == 1 else f"{count:g} tiles"

"""Triangle meshes from files: ``.glb``, ``.gltf``, ``.ply`` and ``.obj``, read by trimesh."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mbtf_core.color import srgb_to_linear
from mbtf_core.config.settings import FileName, Settings
from mbtf_core.data.schema import Tiling
from mbtf_core.errors import InputError, reason
from mbtf_core.files.atomic import data_sha256, file_sha256
from mbtf_core.paths import named_file
from mbtf_gen.config.generator import Positive, Resolution, Rgb, Share, no_tiling
from mbtf_gen.tile.mesh_tile import F64, MeshPart, MeshTile

MESH_FILES = (".glb", ".gltf", ".ply", ".obj")
# glTF files have y up, others z.
_Y_UP = (".glb", ".gltf")
# Triangles of one tile: with Mitsuba's and Embree's own data they take about 150 bytes each.
MOST_TRIANGLES = 20_000_000
# Part of the period by which triangles may reach beyond it.
_BEYOND = 1.0
_GRAY = 0.5


class MeshFile(Settings):
    """Content of a ``material.yaml`` of triangles; file names are relative to its folder."""

    mesh: FileName = Field(description="a .glb, .gltf, .ply or .obj file")
    period: tuple[Positive, Positive] | None = Field(
        None, description="width and height of one period in the file's units; default: the mesh's bounds"
    )
    up: Literal["y", "z"] | None = Field(None, description="axis that points up; default: y for glTF, else z")
    base_color: Rgb | None = Field(
        None, description="linear color of all parts; default: that of the file, else 0.5"
    )
    roughness: Share | None = Field(None, description="roughness of all parts; default: that of the file")
    metallic: Share | None = Field(None, description="metallic of all parts; default: that of the file")
    resolution: Resolution = Field(256, description="texels across at the finest level, a power of two")

    def tiling(self, given: Tiling | None) -> Tiling:
        """Method for maps that do not tile, which these are not."""
        return no_tiling(given)


def read_mesh(spec: MeshFile, folder: Path) -> MeshTile:
    """The tile of a mesh.

    Parameters
    ----------
    spec : MeshFile
        What to read.
    folder : Path
        Folder that its file name is relative to.

    Returns
    -------
    MeshTile

    Raises
    ------
    InputError
        The file cannot be read, or its triangles are no tile.
    """
    path = named_file(folder, spec.mesh)
    shapes = _shapes(path)
    vertices, faces, uv, part = _joined(shapes, path)
    parts = [_part(shape, spec, name) for name, shape in shapes]
    up = spec.up or ("y" if path.suffix.lower() in _Y_UP else "z")
    if up == "y":
        vertices = vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    used = vertices[np.unique(faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    width, height = spec.period or (high[0] - low[0], high[1] - low[1])
    if not (width > 0 and height > 0):
        raise InputError(
            "has no extent along both sides of the tile", where=path, hint="check 'up', or give 'period'"
        )
    over = (high - low)[:2] / (width, height) - 1.0
    if over.max() > _BEYOND:
        raise InputError(
            f"reaches over {1 + over[0]:.3g} x {1 + over[1]:.3g} periods, more than two",
            where=path,
            hint="check 'period'",
        )
    placed = (vertices - (low[0], low[1], high[2])) / width
    tile = MeshTile(height / width, placed, faces, uv, part, parts)
    _, seam = tile.open_edges()
    what = f"{seam} edges at the border have no partner on the opposite side"
    return replace(
        tile,
        files={"mesh": path},
        digests={
            "mesh": file_sha256(path),
            "settings": data_sha256(spec.model_dump(mode="json", exclude={"mesh"})),
        },
        warnings=(f"{path}: {what}: the tile may have a seam; check 'period'",) if seam else (),
        notes=(
            f"mesh: {len(tile.faces):,} triangles in {len(tile.parts)} parts of {path.name}, "
            f"{tile.thickness:.3g} tile widths thick",
        ),
        resolution=spec.resolution,
    )


def _shapes(path: Path) -> list[tuple[str, Any]]:
    """Meshes of a file, with their places in the scene applied."""
    import trimesh

    if path.suffix.lower() not in MESH_FILES:
        raise InputError(f"'{path.suffix}' is not a mesh", where=path, hint=f"give {', '.join(MESH_FILES)}")
    if not path.is_file():
        raise InputError("no such file", where=path)
    try:
        scene = trimesh.load_scene(path, process=False)
        shapes = [(shape.metadata.get("name", "mesh"), shape) for shape in scene.dump()]
    except Exception as error:  # whatever its readers raise
        raise InputError(f"cannot be read as a mesh ({reason(error)})", where=path) from None
    found = [(str(name), shape) for name, shape in shapes if len(getattr(shape, "faces", ()))]
    if not found:
        raise InputError("has no triangles", where=path)
    return found


def _joined(shapes: list[tuple[str, Any]], path: Path) -> tuple[F64, NDArray[np.int_], F64, NDArray[np.int_]]:
    """(vertices, faces, texture coordinates, part of each face) of all shapes, checked."""
    total = sum(len(shape.faces) for _, shape in shapes)
    if total > MOST_TRIANGLES:
        raise InputError(f"has {total:,} triangles, more than {MOST_TRIANGLES:,}", where=path)
    vertices, faces, uvs, part, start = [], [], [], [], 0
    for number, (name, shape) in enumerate(shapes):
        own, corners = np.asarray(shape.vertices, np.float64), np.asarray(shape.faces, np.int64)
        if corners.min() < 0 or corners.max() >= len(own):
            raise InputError(f"'{name}' has a triangle of vertices that it lacks", where=path)
        if not np.isfinite(own[np.unique(corners)]).all() or np.abs(own).max() > 1e15:
            raise InputError(f"'{name}' has vertices that are not finite numbers below 1e15", where=path)
        edges = own[corners[:, 1:]] - own[corners[:, :1]]
        solid = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) > 0
        uv = getattr(shape.visual, "uv", None)
        uv = np.zeros((len(own), 2)) if uv is None else np.asarray(uv, np.float64)
        vertices.append(own)
        uvs.append(np.where(np.isfinite(uv), uv, 0.0))
        faces.append(corners[solid] + start)
        part.append(np.full(int(solid.sum()), number))
        start += len(own)
    if not sum(map(len, faces)):
        raise InputError("has no triangles with an area", where=path)
    return tuple(np.concatenate(a) for a in (vertices, faces, uvs, part))  # type: ignore[return-value]


def _part(shape: Any, spec: MeshFile, name: str) -> MeshPart:
    """Reflectance of one shape: that of the material file, else of the mesh file."""
    material = getattr(shape.visual, "material", None)
    color = _color(material) if spec.base_color is None else np.array(spec.base_color)
    roughness, metallic = _glossiness(material)
    if spec.roughness is not None:
        roughness = spec.roughness
    if spec.metallic is not None:
        metallic = spec.metallic
    if roughness is None and metallic is None:
        return MeshPart(name, color)
    return MeshPart(
        name, color, 0.5 if roughness is None else roughness, 0.0 if metallic is None else metallic
    )


def _color(material: Any) -> F64:
    """Linear color of a material of trimesh: its image times its factor, or one of the two."""
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    factor = getattr(material, "baseColorFactor", None)
    linear = np.ones(3) if factor is None else _shares(factor)[:3]
    if image is not None:
        return np.asarray(srgb_to_linear(_pixels(image)[..., :3]), np.float64) * linear
    if factor is not None:
        return linear
    diffuse = getattr(material, "diffuse", None)
    return (
        np.full(3, _GRAY) if diffuse is None else np.asarray(srgb_to_linear(_shares(diffuse)[:3]), np.float64)
    )


def _glossiness(material: Any) -> tuple[F64 | float | None, F64 | float | None]:
    """(roughness, metallic) of a glTF material; its texture has them in the green and the blue channel."""
    texture = getattr(material, "metallicRoughnessTexture", None)
    factors = [getattr(material, name, None) for name in ("roughnessFactor", "metallicFactor")]
    if texture is None:
        return factors[0], factors[1]
    pixels = _pixels(texture)
    rough, metal = (
        np.clip(pixels[..., k] * (1.0 if f is None else f), 0.0, 1.0)
        for k, f in zip((1, 2), factors, strict=True)
    )
    return rough, metal


def _pixels(image: Any) -> F64:
    return np.asarray(image.convert("RGB"), np.float64) / 255.0


def _shares(color: Any) -> F64:
    """A color in [0, 1]; trimesh has some as integers up to 255."""
    array = np.asarray(color)
    return np.clip(array.astype(np.float64) / (255.0 if array.dtype.kind in "iu" else 1.0), 0.0, 1.0)

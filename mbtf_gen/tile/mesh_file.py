"""Triangle meshes from files as tiles."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mbtf_core.config.settings import FileName, Settings
from mbtf_core.data.schema import Tiling
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import data_sha256, file_sha256
from mbtf_core.meshes.content import (
    F64,
    MOST_TRIANGLES,
    MeshShape,
    Texture,
    Value,
    joined,
    numbers_of,
    of_faces,
)
from mbtf_core.meshes.read import read_mesh_content, seems_up
from mbtf_core.paths import named_file
from mbtf_gen.config.generator import Positive, Resolution, Rgb, Share, no_tiling
from mbtf_gen.tile.maps.material_file import LOBES, ROLES
from mbtf_gen.tile.mesh_tile import MeshPart, MeshTile

# The roles of files that a mesh names begin with it.
COMPANION = "mesh."
# Part of the period by which triangles may reach beyond it.
_BEYOND = 1.0
_GRAY = 0.5
# Largest values of roles beyond 1: a specular of this has F0 = 1.
_MOST = {"specular": 12.5}
# Roles that a material file may replace.
_GIVEN = ("base_color", "roughness", "metallic")


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
    """The tile of a mesh; an InputError if the file cannot be read, or its triangles are no tile."""
    path = named_file(folder, spec.mesh)
    content = read_mesh_content(path)
    shapes = [_shape(shape, spec, path) for shape in content.shapes]
    vertices, faces, uv, part = _joined(shapes, path)
    parts = [MeshPart(shape.name, shape.values) for shape in shapes]
    up = spec.up or content.up
    warnings = [f"{path}: {text}" for text in content.warnings]
    other: Literal["y", "z"] = "z" if up == "y" else "y"
    if spec.up is None and seems_up(other, vertices, faces):
        warnings.append(f"{path}: it looks like {other} is up: if so, give 'up: {other}' in a material.yaml")
    if spec.base_color is None and any(map(_lacks_image, content.shapes)):
        warnings.append(f"{path}: has texture coordinates, but names no image: the color is {_GRAY:g}")
    if up == "y":
        vertices = vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    used = of_faces(vertices, faces)
    low, high = used.min(axis=0), used.max(axis=0)
    width, height = spec.period or (high[0] - low[0], high[1] - low[1])
    if not (width > 0 and height > 0):
        raise InputError(
            "has no extent along both sides of the tile",
            where=path,
            hint="if y is up, give 'up: y' in a material.yaml; else give 'period'",
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
    files = {"mesh": path, **{f"{COMPANION}{name}": file for name, file in content.files.items()}}
    _, seam = tile.open_edges()
    what = f"{seam} edges at the border have no partner on the opposite side"
    parts_of_file = f"{len(tile.parts)} part{'s' * (len(tile.parts) != 1)}"
    return replace(
        tile,
        files=files,
        digests={
            **{role: file_sha256(file) for role, file in files.items()},
            # The number rises when the same file is read as another material.
            "settings": data_sha256([3, spec.model_dump(mode="json", exclude={"mesh"})]),
        },
        warnings=(
            *warnings,
            *([f"{path}: {what}: the tile may have a seam; check 'period'"] if seam else ()),
        ),
        notes=(
            f"mesh: {len(tile.faces):,} triangles in {parts_of_file} of {path.name}, "
            f"{tile.thickness:.3g} tile widths thick",
        ),
        resolution=spec.resolution,
    )


def _shape(shape: MeshShape, spec: MeshFile, path: Path) -> MeshShape:
    """A shape with the reflectance of the material file, else of its own, complete and checked, and without
    triangles that have no area."""
    given = {role: getattr(spec, role) for role in _GIVEN if getattr(spec, role) is not None}
    for role, fault in shape.faults.items():
        if role not in given:
            raise fault
    vertices, faces = shape.vertices, shape.faces
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise InputError(f"'{shape.name}' has a triangle of vertices that it lacks", where=path)
    used = of_faces(vertices, faces)
    if not np.isfinite(used).all() or np.abs(used).max(initial=0.0) > 1e15:
        raise InputError(f"'{shape.name}' has vertices that are not finite numbers below 1e15", where=path)
    edges = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    faces = faces[np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) > 0]
    found = replace(
        shape,
        faces=faces,
        colors=None if "base_color" in given or not len(faces) else shape.colors,
        values={**shape.values, **{role: np.asarray(value) for role, value in given.items()}},
    )
    try:
        found = with_vertex_colors(found)
        values = _complete(found.values)
        uv = None if found.uv is None else of_faces(found.uv, found.faces)
        for role, value in values.items():
            _check(shape.name, role, value, uv)
    except InputError as error:
        raise InputError(error.what, where=error.where or path, hint=error.hint) from None
    return replace(found, values=values)


def _complete(values: dict[str, Value]) -> dict[str, Value]:
    """Values of a shape with those that others need: a glossy lobe has all of its parameters."""
    defaults: dict[str, Value] = {"base_color": np.full(3, _GRAY)}
    if values.keys() & LOBES.keys():
        defaults |= LOBES
    for name, role in ROLES.items():
        if role.effect in values and role.default is not None:
            defaults[name] = role.default
    return {**defaults, **values}


def _check(name: str, role: str, value: Value, uv: F64 | None) -> None:
    """Refuse numbers out of range, and textures that the texture coordinates of a part do not place."""
    most = _MOST.get(role, 1.0)
    if isinstance(value, tuple):
        if uv is None or not np.isfinite(uv).all() or not np.isfinite(value[0].to_uv).all():
            raise InputError(f"'{name}' has no valid texture coordinates for its {role}")
        if len({*value[0].wrap}) > 1:
            what = f"a texture of '{name}' has another wrap mode along u than along v"
            raise InputError(what, hint="give it one, such as REPEAT")
        # Texels beyond what a triangle shows may be out of range.
        value = value[1]
    numbers = numbers_of(value)
    if not (np.isfinite(numbers).all() and numbers.min() >= 0.0 and numbers.max() <= most):
        text = ", ".join(f"{number:g}" for number in numbers.ravel())
        raise InputError(f"'{name}' has the {role} {text}, not within 0 and {most:g}")


def _lacks_image(shape: MeshShape) -> bool:
    """Whether texture coordinates have nothing to place."""
    colored = shape.colors is not None or "base_color" in {*shape.values, *shape.faults}
    return shape.uv is not None and not colored and bool(np.ptp(shape.uv) > 0)


def _joined(shapes: list[MeshShape], path: Path) -> tuple[F64, NDArray[np.int_], F64, NDArray[np.int_]]:
    """(vertices, faces, texture coordinates, part of each face) of all shapes."""
    counts = [len(shape.faces) for shape in shapes]
    if not sum(counts):
        raise InputError("has no triangles with an area", where=path)
    if sum(counts) > MOST_TRIANGLES:
        raise InputError(f"has {sum(counts):,} triangles, more than {MOST_TRIANGLES:,}", where=path)
    uv = np.concatenate([_placing(shape) for shape in shapes])
    return *joined(shapes), uv, np.repeat(np.arange(len(shapes)), counts)


def _placing(shape: MeshShape) -> F64:
    """Texture coordinates (n, 2), of a shape without textures zeros."""
    textured = any(isinstance(value, tuple) for value in shape.values.values())
    return np.zeros((len(shape.vertices), 2)) if shape.uv is None or not textured else shape.uv


def with_vertex_colors(shape: MeshShape) -> MeshShape:
    """A shape whose base color includes the colors of its vertices.

    Colors that are all equal become a factor. Others become a texture of 2 x 2 texels per triangle: bilinear
    interpolation between the centers of three of them is linear, if the fourth continues their plane. A shape
    that has textures as well is refused.
    """
    if shape.colors is None:
        return shape
    base = shape.values.get("base_color", np.ones(3))
    corners = shape.colors[shape.faces]
    if np.ptp(corners.reshape(-1, 3), axis=0).max() == 0.0:
        color = corners[0, 0]
        base = (base[0], color * base[1]) if isinstance(base, tuple) else color * base
        return replace(shape, colors=None, values={**shape.values, "base_color": base})
    if any(isinstance(value, tuple) for value in shape.values.values()):
        raise InputError(
            f"'{shape.name}' has both textures and varying colors of its vertices",
            hint="bake the colors into the texture of the base color, or remove them",
        )
    pixels, uv = _atlas(corners)
    return replace(
        shape,
        vertices=shape.vertices[shape.faces].reshape(-1, 3),
        faces=np.arange(3 * len(corners)).reshape(-1, 3),
        uv=uv,
        colors=None,
        values={**shape.values, "base_color": (Texture(pixels), base)},
    )


def _atlas(corners: F64) -> tuple[NDArray[np.float32], F64]:
    """Texture (h, w, 3) of the colors (m, 3, 3) of triangles' corners, and the corners' texture coordinates
    (3 m, 2), v up."""
    count = len(corners)
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    blocks = np.zeros((rows * columns, 4, 3), np.float32)
    # So that the mean of the texels is about that of the surface.
    blocks[count:] = corners.mean(axis=(0, 1))
    blocks[:count, :3] = corners
    blocks[:count, 3] = corners[:, 1] + corners[:, 2] - corners[:, 0]
    pixels = blocks.reshape(rows, columns, 2, 2, 3).swapaxes(1, 2).reshape(2 * rows, 2 * columns, 3)
    row, column = np.divmod(np.arange(count), columns)
    center = 2.0 * np.stack([column, row], axis=-1)[:, None] + 0.5 + np.array([[0, 0], [1, 0], [0, 1]])
    uv = center / (2 * columns, 2 * rows) * (1, -1) + (0, 1)
    return pixels, uv.reshape(-1, 2)

"""Triangles and materials of glTF 2.0 files (Khronos Group 2021, "glTF 2.0 Specification").

The default scene is read with all transforms and instances applied, in its rest pose. Triangles of one
material are one shape.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.meshes.content import F64, MOST_TRIANGLES, MeshContent, MeshShape
from mbtf_core.meshes.gltf_buffers import FLOAT, HINTS, READ, GltfFile
from mbtf_core.meshes.gltf_material import Materials
from mbtf_core.meshes.gltf_schema import GltfMaterial, GltfMesh, GltfNode, GltfPrimitive

Faces = NDArray[np.int64]

_STRIP, _FAN = 5, 6
_CUT = "colors of vertices outside of [0, 1] are clamped"
# Transforms of a node that has none.
_AT_REST = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
# Largest deviation of a quaternion's length from one; quantized ones deviate by one hundredth.
_UNIT = 0.05


@dataclass
class _Piece:
    """Triangles of a primitive."""

    vertices: F64
    faces: Faces
    uv: F64 | None
    colors: F64 | None
    normals: F64 | None


@dataclass
class _Group:
    """Primitives of one material that have the same set of texture coordinates, by its number."""

    name: str
    material: GltfMaterial
    uv_set: int | None
    pieces: list[_Piece] = field(default_factory=list)


def read_gltf(path: Path) -> MeshContent:
    """Read a ``.gltf`` or ``.glb`` file; an InputError where it is damaged, or has what is not read and
    cannot be left out."""
    file = GltfFile(path)
    materials = Materials(file)
    placed = _placements(file)
    groups: dict[tuple[object, ...], _Group] = {}
    total, others = 0, False
    for number, matrices in placed.items():
        mesh = file.document.meshes[number]
        for position, primitive in enumerate(mesh.primitives):
            if primitive.mode < 4:
                others = True
                continue
            material = materials.of(primitive.material)
            sets = materials.uv_sets(primitive.material)
            uv_set = next((n for n in sets if f"TEXCOORD_{n}" in primitive.attributes), None)
            try:
                piece = _piece(file, primitive, material, uv_set)
            except InputError as error:
                what = f"'meshes.{number}.primitives.{position}': {error.what}"
                raise InputError(what, where=error.where, hint=error.hint) from None
            total += len(piece.faces) * len(matrices)
            if total > MOST_TRIANGLES:
                raise InputError(f"has {total:,} triangles, more than {MOST_TRIANGLES:,}", where=path)
            if not len(piece.faces):
                continue
            key = (primitive.material, uv_set, piece.colors is None, piece.normals is None)
            name = material.name or mesh.name or "part"
            group = groups.setdefault(key, _Group(name, material, uv_set))
            group.pieces.append(_instances(piece, matrices))
    shapes = [_shape(group, materials) for group in groups.values()]
    if others:
        file.warnings.append("points and lines are not used")
    if file.document.animations:
        file.warnings.append("animations are not used")
    file.warnings += [f"{name} is not used" for name in file.extensions if name not in READ]
    return MeshContent(shapes, file.files, "y", file.warnings)


def _placements(file: GltfFile) -> dict[int, F64]:
    """Matrices (k, 4, 4) of each mesh of the default scene, one per instance."""
    document = file.document
    nodes, scenes = document.nodes, document.scenes
    if scenes or document.scene is not None:
        if document.scene is None and len(scenes) > 1:
            file.warnings.append(f"of {len(scenes)} scenes the first is used; none is the default")
        roots = list(file.entry(scenes, document.scene or 0, "scenes").nodes)
    else:
        below = {child for node in nodes for child in node.children}
        roots = [index for index in range(len(nodes)) if index not in below]
    locals_ = _locals(file)
    found: dict[int, list[F64]] = {}
    seen: set[int] = set()
    waiting = [(index, np.eye(4)) for index in reversed(roots)]
    while waiting:
        index, above = waiting.pop()
        node = file.entry(nodes, index, "nodes")
        if index in seen:
            raise InputError(f"node {index} has two parents or contains itself", where=file.path)
        seen.add(index)
        matrix = above @ locals_[index]
        if node.mesh is not None:
            mesh = file.entry(document.meshes, node.mesh, "meshes")
            _check_pose(node, mesh, file)
            found.setdefault(node.mesh, []).append(matrix)
        waiting += [(child, matrix) for child in reversed(node.children)]
    outside = sum(node.mesh is not None for index, node in enumerate(nodes) if index not in seen)
    if outside:
        file.warnings.append(f"{outside} nodes with meshes are not in the scene and not used")
    return {mesh: np.stack(matrices) for mesh, matrices in found.items()}


def _check_pose(node: GltfNode, mesh: GltfMesh, file: GltfFile) -> None:
    """Refuse poses that bones and weights define, and instances beside nodes."""
    name = node.name or mesh.name
    if node.skin is not None:
        hint = "apply the armature and export it again"
        raise InputError(f"'{name}' is posed by a skeleton, which is not read", where=file.path, hint=hint)
    if node.instancing is not None:
        hint = HINTS["EXT_mesh_gpu_instancing"]
        raise InputError(f"'{name}' has GPU instances, which are not read", where=file.path, hint=hint)
    if any(node.weights or mesh.weights):
        hint = "apply the shape keys and export it again"
        raise InputError(f"'{name}' is a blend of morph targets, not read", where=file.path, hint=hint)


def _locals(file: GltfFile) -> F64:
    """Matrices (nodes, 4, 4) of all nodes relative to their parents."""
    nodes = file.document.nodes
    if not nodes:
        return np.zeros((0, 4, 4))
    translation, rotation, scale = (
        np.array([getattr(node, name) or default for node in nodes], np.float64)
        for name, default in _AT_REST.items()
    )
    out = _transforms(translation, rotation, scale, file)
    for index, node in enumerate(nodes):
        if node.matrix is not None:
            out[index] = np.array(node.matrix).reshape(4, 4).T
            if out[index, 3].tolist() != [0, 0, 0, 1] or node.translation or node.rotation or node.scale:
                what = f"node {index} has a matrix that is projective or stands beside other transforms"
                raise InputError(what, where=file.path)
    return out


def _transforms(translation: F64, rotation: F64, scale: F64, file: GltfFile) -> F64:
    """Matrices (k, 4, 4) from translations (k, 3), quaternions (k, 4) and scales (k, 3)."""
    from scipy.spatial.transform import Rotation

    wrong = ~(np.abs(np.linalg.norm(rotation, axis=1) - 1.0) < _UNIT)
    if wrong.any():
        text = ", ".join(f"{number:g}" for number in rotation[wrong][0])
        raise InputError(f"the rotation {text} is no unit quaternion", where=file.path)
    out = np.zeros((len(translation), 4, 4))
    out[:, :3, :3] = Rotation.from_quat(rotation).as_matrix() * scale[:, None, :]
    out[:, :3, 3] = translation
    out[:, 3, 3] = 1.0
    return out


def _piece(file: GltfFile, primitive: GltfPrimitive, material: GltfMaterial, uv_set: int | None) -> _Piece:
    """A primitive as its file stores it."""
    vertices, faces = _triangles(file, primitive)
    uv = _attribute(file, primitive, f"TEXCOORD_{uv_set}", (2,), len(vertices))
    uv = None if uv is None else uv * (1, -1) + (0, 1)  # v up
    colors = _colors(file, primitive, material, len(vertices))
    return _Piece(vertices, faces, uv, colors, _attribute(file, primitive, "NORMAL", (3,), len(vertices)))


def _triangles(file: GltfFile, primitive: GltfPrimitive) -> tuple[F64, Faces]:
    """Positions (n, 3) and triangles (m, 3) of a primitive."""
    attributes = primitive.attributes
    if "POSITION" not in attributes:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    needed = [attributes["POSITION"], *([] if primitive.indices is None else [primitive.indices])]
    for name in primitive.extensions.keys() & HINTS.keys():
        if any(file.entry(file.document.accessors, i, "accessors").bufferView is None for i in needed):
            raise InputError(f"is compressed with {name}, not read", where=file.path, hint=HINTS[name])
    vertices = file.vectors(attributes["POSITION"], (3,), "positions")
    corners = np.arange(len(vertices)) if primitive.indices is None else file.indices(primitive.indices)
    if corners.max() >= len(vertices):
        raise InputError("has triangles of vertices that it lacks", where=file.path)
    if primitive.mode == _STRIP:
        first, odd = corners[:-2], np.arange(max(len(corners) - 2, 0)) % 2 == 1
        second, third = corners[1:-1], corners[2:]
        faces = np.stack([first, np.where(odd, third, second), np.where(odd, second, third)], axis=1)
    elif primitive.mode == _FAN:
        faces = np.stack([corners[1:-1], corners[2:], np.full(max(len(corners) - 2, 0), corners[0])], axis=1)
    elif len(corners) % 3:
        raise InputError(f"has triangles of {len(corners)} corners, no multiple of 3", where=file.path)
    else:
        faces = corners.reshape(-1, 3)
    return vertices, faces


def _attribute(
    file: GltfFile, primitive: GltfPrimitive, name: str, widths: tuple[int, ...], count: int
) -> F64 | None:
    """Numbers (count, width) of a primitive's vertices; None where it lacks them."""
    index = primitive.attributes.get(name)
    if index is None:
        return None
    values = file.vectors(index, widths, name)
    if len(values) != count:
        raise InputError(f"has {len(values)} of {name} for {count} vertices", where=file.path)
    return values


def _colors(file: GltfFile, primitive: GltfPrimitive, material: GltfMaterial, count: int) -> F64 | None:
    """Linear colors (n, 3) of the vertices."""
    colors = _attribute(file, primitive, "COLOR_0", (3, 4), count)
    if "COLOR_1" in primitive.attributes and "COLOR_1 is not used" not in file.warnings:
        file.warnings.append("COLOR_1 is not used")
    if colors is None:
        return None
    accessor = file.document.accessors[primitive.attributes["COLOR_0"]]
    if not accessor.normalized and accessor.componentType != FLOAT:
        raise InputError("COLOR_0 holds integers that are not normalized", where=file.path)
    if not ((colors >= 0.0) & (colors <= 1.0)).all() and _CUT not in file.warnings:
        file.warnings.append(_CUT)
    if material.alphaMode != "OPAQUE" and (colors[:, 3:] != 1.0).any():
        hint = "bake it into the texture of the base color"
        raise InputError("has vertices with alpha, which is not read", where=file.path, hint=hint)
    return np.clip(colors[:, :3], 0.0, 1.0)


def _instances(piece: _Piece, matrices: F64) -> _Piece:
    """A primitive at all its places. Mirroring matrices turn its triangles around."""
    count, copies = len(piece.vertices), len(matrices)
    with np.errstate(over="ignore", invalid="ignore"):
        placed = np.einsum("kij,nj->kni", matrices[:, :3, :3], piece.vertices) + matrices[:, None, :3, 3]
        mirrored = np.linalg.det(matrices[:, :3, :3]) < 0
        normals = piece.normals
        if normals is not None:
            # The inverse transpose up to a positive factor, of flat matrices too.
            rows = matrices[:, :3, :3]
            inverse = np.cross(np.roll(rows, -1, axis=1), np.roll(rows, -2, axis=1))
            inverse[mirrored] *= -1
            normals = np.einsum("kij,nj->kni", inverse, normals).reshape(-1, 3)
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    faces = np.repeat(piece.faces[None], copies, axis=0)
    faces[mirrored] = faces[mirrored][..., ::-1]
    faces += count * np.arange(copies)[:, None, None]
    return _Piece(
        placed.reshape(-1, 3),
        faces.reshape(-1, 3),
        None if piece.uv is None else np.tile(piece.uv, (copies, 1)),
        None if piece.colors is None else np.tile(piece.colors, (copies, 1)),
        normals,
    )


def _shape(group: _Group, materials: Materials) -> MeshShape:
    """All triangles of a group as one shape."""
    pieces = group.pieces
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces[:-1])])
    values, faults = materials.read(group.material, group.uv_set)
    uv = [piece.uv for piece in pieces if piece.uv is not None]
    colors = [piece.colors for piece in pieces if piece.colors is not None]
    normals = [piece.normals for piece in pieces if piece.normals is not None]
    return MeshShape(
        group.name,
        np.concatenate([piece.vertices for piece in pieces]),
        np.concatenate([piece.faces + start for piece, start in zip(pieces, starts, strict=True)]),
        np.concatenate(uv) if uv else None,
        np.concatenate(colors) if colors else None,
        values,
        faults,
        np.concatenate(normals) if normals else None,
    )

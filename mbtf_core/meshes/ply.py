"""PLY: polygons with colors and texture coordinates of vertices or of faces."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import InputError
from mbtf_core.meshes.companions import Companions
from mbtf_core.meshes.content import F64, MeshContent, MeshShape, Texture, groups_of, with_colors
from mbtf_core.meshes.ply_elements import Element, Elements, read_elements
from mbtf_core.meshes.polygons import UNCUT, triangulate

I64 = NDArray[np.int64]
_POSITION, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_CORNERS = ("vertex_indices", "vertex_index")
_WEDGE, _IMAGE = "texcoord", "texnumber"
# Largest number of integer colors.
_MOST = {"uint8": 255.0, "uint16": 65535.0}
_TEXTURE = "TextureFile"


def read_ply(path: Path) -> MeshContent:
    """Read a PLY file.

    There is a shape for each image, or a single one, and another one for triangles that lack texture
    coordinates. Integer colors are sRGB, floats are linear.

    Parameters
    ----------
    path : the file

    Raises
    ------
    InputError : the file is no PLY file, is damaged or cut, or has no triangles
    """
    content = read_elements(path)
    vertex, face = _element(content, "vertex", path), content.elements.get("face")
    if face is None or not face.count:
        strips = "tristrips" in content.elements
        raise InputError(
            "has no triangles: " + ("it has triangle strips" if strips else "it is a cloud of points"),
            where=path,
            hint="convert them to triangles, for example in MeshLab" if strips else "reconstruct a surface",
        )
    corners = next((name for name in _CORNERS if name in face.lists), None)
    if corners is None:
        raise InputError(f"its faces have no list {_CORNERS[0]}", where=path)
    if not set(_POSITION) <= vertex.columns.keys():
        raise InputError("its vertices have no x, y and z", where=path)
    positions = _stacked(vertex, _POSITION)
    stored, sizes = face.lists[corners]
    if not ((stored >= 0) & (stored < len(positions))).all():
        raise InputError(f"a face has a vertex that the file lacks; there are {len(positions):,}", where=path)
    number = stored.astype(np.int64)
    triangles, polygon, uncut = triangulate(positions[number], sizes)
    if not len(triangles):
        raise InputError("has no triangles", where=path)

    companions, warnings = Companions(path), _unused(content)
    uv, colors, normals = _uv(vertex, face, number, sizes), _colors(vertex, face, number, sizes), None
    if set(_NORMAL) <= vertex.columns.keys():
        normals = _stacked(vertex, _NORMAL)[number]
    placed = np.asarray(np.isfinite(uv).all(axis=1))
    textured = np.asarray(placed[triangles].all(axis=1))
    image = np.nan_to_num(face.columns.get(_IMAGE, np.zeros(face.count))).astype(np.int64)[polygon]
    # What faces say of their corners makes vertices of them.
    split = _WEDGE in face.lists or bool(_face_colors(vertex, face))
    vertex_of = np.arange(len(number)) if split else number
    shapes = []
    for group in groups_of(2 * image + textured):
        own = triangles[group].ravel()
        _, first, faces = np.unique(vertex_of[own], return_index=True, return_inverse=True)
        used = own[first]
        values, faults = _base_color(int(image[group[0]]), content.comments, companions)
        shape = MeshShape(
            path.name,
            positions[number[used]],
            faces.reshape(-1, 3),
            uv[used] if textured[group[0]] else None,
            None if colors is None else colors[used],
            values,
            faults,
            None if normals is None else normals[used],
        )
        shapes.append(with_colors(shape, path, warnings))
    if uncut:
        warnings.append(UNCUT.format(uncut))
    return MeshContent(shapes, companions.files, None, [*warnings, *companions.warnings])


def _element(content: Elements, name: str, path: Path) -> Element:
    if name not in content.elements:
        raise InputError(f"has no element '{name}'", where=path)
    return content.elements[name]


def _stacked(element: Element, names: tuple[str, ...]) -> F64:
    """(n, k) numbers of some properties."""
    return np.stack([element.columns[name] for name in names], axis=-1)


def _first(element: Element, choices: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """The first choice of properties that an element has; empty for none."""
    return next((names for names in choices if set(names) <= element.columns.keys()), ())


def _uv(vertex: Element, face: Element, number: I64, sizes: I64) -> F64:
    """Texture coordinates (c, 2) of corners, NaN where they have none."""
    out = np.full((len(number), 2), np.nan)
    if _WEDGE in face.lists:
        numbers, lengths = face.lists[_WEDGE]
        fits = lengths == 2 * sizes
        out[np.repeat(fits, sizes)] = numbers[np.repeat(fits, lengths)].reshape(-1, 2)
    elif names := _first(vertex, _UV):
        out = _stacked(vertex, names)[number]
    return out


def _face_colors(vertex: Element, face: Element) -> tuple[str, ...]:
    """Properties of the colors of faces, of which those of vertices take the place."""
    return () if _first(vertex, _COLORS) else _first(face, _COLORS)


def _colors(vertex: Element, face: Element, number: I64, sizes: I64) -> F64 | None:
    """Linear colors (c, 3) of corners; None without any."""
    of_face = _face_colors(vertex, face)
    element, names = (face, of_face) if of_face else (vertex, _first(vertex, _COLORS))
    if not names:
        return None
    kind = element.kind(names[0])
    colors = _stacked(element, names)
    if not kind.startswith("float"):
        colors = np.asarray(srgb_to_linear(colors / _MOST.get(kind, 255.0)), np.float64)
    return np.repeat(colors, sizes, axis=0) if of_face else colors[number]


def _base_color(
    image: int, comments: list[str], companions: Companions
) -> tuple[dict[str, Any], dict[str, InputError]]:
    """(values, faults) of the image of a number."""
    names = [text.partition(" ")[2].strip() for text in comments if text.split()[:1] == [_TEXTURE]]
    if image < 0 or not names:
        return {}, {}
    try:
        if image >= len(names):
            raise InputError(
                f"names {len(names)} images, of which face {image} is none", where=companions.path
            )
        return {"base_color": (Texture(companions.color(names[image])), np.ones(3))}, {}
    except InputError as fault:
        return {}, {"base_color": fault}


def _unused(content: Elements) -> list[str]:
    """Warnings of what the file has that is not used."""
    vertex, face = content.elements["vertex"], content.elements["face"]
    wedge = _WEDGE in face.lists
    used = {
        "vertex": {*_POSITION, *_NORMAL, *_first(vertex, _COLORS), *(() if wedge else _first(vertex, _UV))},
        "face": {*_CORNERS, _WEDGE, _IMAGE, *_face_colors(vertex, face)},
    }
    out = []
    for name, element in content.elements.items():
        if name not in used:
            out += [f"its elements '{name}' are not used"] if element.count else []
            continue
        opaque = _MOST.get(element.kind("alpha"), 1.0) if "alpha" in element.columns else None
        if opaque is not None and (element.columns["alpha"] >= opaque).all():
            used[name].add("alpha")
        if unused := [one.name for one in element.properties if one.name not in used[name]]:
            out.append(
                f"{', '.join(unused)} of its {name} elements {'is' if len(unused) == 1 else 'are'} not used"
            )
    if content.rest:
        out.append("it has more numbers after its last element, which are not used")
    return out

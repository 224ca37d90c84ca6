"""PLY: polygons with colors and texture coordinates of vertices or of faces."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import InputError
from mbtf_core.meshes.companions import Companions
from mbtf_core.meshes.content import (
    F64,
    I64,
    MeshContent,
    MeshShape,
    Texture,
    groups_of,
    parse,
    read_bytes,
    with_colors,
)
from mbtf_core.meshes.mtl import as_text
from mbtf_core.meshes.polygons import CROSSING, triangulate

_TYPES = {
    **{name: name for name in ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")},
    "char": "int8",
    "uchar": "uint8",
    "short": "int16",
    "ushort": "uint16",
    "int": "int32",
    "uint": "uint32",
    "float": "float32",
    "double": "float64",
}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MOST_HEADER = 1 << 20
# Of a number of rows; Python refuses to read thousands of digits.
_MOST_DIGITS = 18
_SHORT = "ends before its last element: check that the file is complete"


@dataclass(frozen=True)
class _Property:
    """A property of an element."""

    name: str
    # NumPy's names of its type, and of the type of the length of a list; None for a single number.
    kind: str
    length: str | None = None


@dataclass
class _Element:
    """Rows of one kind, such as vertices."""

    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)
    # Single numbers (count,) of the rows; lists: their numbers, row after row, and their lengths (count,).
    columns: dict[str, F64] = field(default_factory=dict)
    lists: dict[str, tuple[F64, I64]] = field(default_factory=dict)

    def kind(self, name: str) -> str:
        """Type of a property."""
        return next(p.kind for p in self.properties if p.name == name)


@dataclass(frozen=True)
class _Elements:
    """Content of a PLY file; `rest` is bytes, or numbers of a text, after the last element."""

    elements: dict[str, _Element]
    comments: list[str]
    rest: int


def _read_elements(path: Path) -> _Elements:
    """All elements of a PLY file."""
    data = read_bytes(path)
    end = re.search(rb"(?:^|[\r\n])end_header[ \t]*(\r\n|\n|\r)", data[:_MOST_HEADER])
    if not data.startswith(b"ply") or end is None:
        raise InputError("is not a PLY file: its header is damaged", where=path)
    order, elements, comments = _header(as_text(data[: end.start()]), path)
    body = _Body(data[end.end() :], order, path)
    for element in elements:
        body.read(element)
    return _Elements({element.name: element for element in elements}, comments, body.rest)


def _header(text: str, path: Path) -> tuple[Literal["", "<", ">"], list[_Element], list[str]]:
    """Byte order, elements without rows, and comments."""
    order, elements, comments = None, list[_Element](), list[str]()
    for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1):
        match line.split():
            case ["comment" | "obj_info", *_]:
                comments.append(line.strip().partition(" ")[2].strip())
            case ["format", name, *_] if name in _FORMATS:
                order = _FORMATS[name]
            case ["element", name, count] if count.isdecimal() and len(count) <= _MOST_DIGITS:
                elements.append(_Element(name, int(count)))
            case ["property", "list", length, kind, name] if (
                elements and kind in _TYPES and _TYPES.get(length, "float")[0] != "f"
            ):
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[kind]))
            case [] | ["ply"]:
                pass
            case _:
                raise InputError(f"'{line[:60]}' is no line of a PLY header", where=f"{path}, line {number}")
    if order is None:
        raise InputError("its header names none of the formats of PLY", where=path)
    for names in ([e.name for e in elements], *([p.name for p in e.properties] for e in elements)):
        if len(set(names)) < len(names):
            raise InputError("its header names an element or a property twice", where=path)
    return order, elements, comments  # type: ignore[return-value]


class _Body:
    """What follows the header, in cells: numbers of a text, or bytes."""

    def __init__(self, data: bytes, order: Literal["", "<", ">"], path: Path) -> None:
        self.order, self.path, self.position = order, path, 0
        cells = np.frombuffer(data, np.uint8) if order else parse(data, np.float64)
        if cells is None:
            raise InputError("has words that are no numbers after its header", where=path)
        self.cells: NDArray[Any] = cells

    @property
    def rest(self) -> int:
        """Cells that are left."""
        return len(self.cells) - self.position

    def read(self, element: _Element) -> None:
        """Read the rows of an element."""
        least = sum(self._size(one.length or one.kind) for one in element.properties)
        if element.count * least > self.rest:
            raise InputError(
                f"claims {element.count:,} rows of '{element.name}', more than are there",
                where=self.path,
                hint="check that the file is complete",
            )
        if element.count and least and not self._read_alike(element):
            self._read_ragged(element)

    def _read_alike(self, element: _Element) -> bool:
        """Read rows at once, if all are as long as the first one."""
        ranges, width = [], 0
        for one in element.properties:
            length = None
            if one.length is not None:
                length = self._length(self.position + width, one.length)
                width += self._size(one.length)
            end = width + self._size(one.kind) * (1 if length is None else length)
            ranges.append((one, length, width, end))
            width = end
        if element.count * width > self.rest:
            return False
        end = self.position + element.count * width
        rows = self.cells[self.position : end].reshape(element.count, width)
        for one, length, begin, _ in ranges:
            if one.length is not None:
                lengths = self._decoded(rows[:, begin - self._size(one.length) : begin], one.length)
                if not (lengths == length).all():
                    return False
        for one, length, begin, stop in ranges:
            numbers = self._decoded(rows[:, begin:stop], one.kind)
            if length is None:
                element.columns[one.name] = numbers
            else:
                element.lists[one.name] = numbers, np.full(element.count, length)
        self.position = end
        return True

    def _read_ragged(self, element: _Element) -> None:
        """Read rows one by one."""
        position = self.position
        places = {one.name: (list[int](), list[int]()) for one in element.properties}
        layout = [(*places[p.name], p.length, self._size(p.kind)) for p in element.properties]
        sizes = {p.length: self._size(p.length) for p in element.properties if p.length is not None}
        for _ in range(element.count):
            for starts, lengths, kind, size in layout:
                length = 1
                if kind is not None:
                    length = self._length(position, kind)
                    position += sizes[kind]
                starts.append(position)
                lengths.append(length)
                position += length * size
        if position > len(self.cells):
            raise InputError(_SHORT, where=self.path)
        for one in element.properties:
            first, counts = (np.array(numbers, np.int64) for numbers in places[one.name])
            size = self._size(one.kind)
            within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
            cells = np.repeat(first, counts) + within * size
            numbers = self._decoded(self.cells[cells[:, None] + np.arange(size)], one.kind)
            if one.length is None:
                element.columns[one.name] = numbers
            else:
                element.lists[one.name] = numbers, counts
        self.position = position

    def _size(self, kind: str) -> int:
        """Cells of a number."""
        return np.dtype(kind).itemsize if self.order else 1

    def _decoded(self, cells: NDArray[Any], kind: str) -> F64:
        """Numbers of rows of cells."""
        if self.order != "":
            stored = np.dtype(kind).newbyteorder(self.order)
            cells = np.ascontiguousarray(cells).view(stored)
        return cells.astype(np.float64).ravel()

    def _length(self, position: int, kind: str) -> int:
        """Length of the list that starts at a cell."""
        size = self._size(kind)
        if position + size > len(self.cells):
            raise InputError(_SHORT, where=self.path)
        if kind == "uint8" and self.order:
            return int(self.cells[position])
        length = float(self._decoded(self.cells[position : position + size], kind)[0])
        if not (0 <= length <= self.rest and length == int(length)):
            raise InputError(f"has a list of {length:g} numbers", where=self.path)
        return int(length)


_POSITION, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_CORNERS = ("vertex_indices", "vertex_index")
_WEDGE, _IMAGE = "texcoord", "texnumber"
# Largest number of integer colors.
_MOST = {"uint8": 255.0, "uint16": 65535.0}
_TEXTURE = "TextureFile"


def read_ply(path: Path) -> MeshContent:
    """Read a PLY file; an InputError where it is none, is damaged or cut, or has no triangles.

    There is a shape for each image, or a single one, and another one for triangles that lack texture
    coordinates. Integer colors are sRGB, floats are linear.
    """
    content = _read_elements(path)
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
    if not ((stored >= 0) & (stored < len(positions)) & (stored == np.floor(stored))).all():
        raise InputError(f"a face has a vertex that the file lacks; there are {len(positions):,}", where=path)
    number = stored.astype(np.int64)
    triangles, polygon, crossing = triangulate(positions[number], sizes)
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
    if crossing:
        warnings.append(CROSSING.format(crossing))
    return MeshContent(shapes, companions.files, None, [*warnings, *companions.warnings])


def _element(content: _Elements, name: str, path: Path) -> _Element:
    if name not in content.elements:
        raise InputError(f"has no element '{name}'", where=path)
    return content.elements[name]


def _stacked(element: _Element, names: tuple[str, ...]) -> F64:
    """(n, k) numbers of some properties."""
    return np.stack([element.columns[name] for name in names], axis=-1)


def _first(element: _Element, choices: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """The first choice of properties that an element has; empty for none."""
    return next((names for names in choices if set(names) <= element.columns.keys()), ())


def _uv(vertex: _Element, face: _Element, number: I64, sizes: I64) -> F64:
    """Texture coordinates (c, 2) of corners, NaN where they have none."""
    out = np.full((len(number), 2), np.nan)
    if _WEDGE in face.lists:
        numbers, lengths = face.lists[_WEDGE]
        fits = lengths == 2 * sizes
        out[np.repeat(fits, sizes)] = numbers[np.repeat(fits, lengths)].reshape(-1, 2)
    elif names := _first(vertex, _UV):
        out = _stacked(vertex, names)[number]
    return out


def _face_colors(vertex: _Element, face: _Element) -> tuple[str, ...]:
    """Properties of the colors of faces, of which those of vertices take the place."""
    return () if _first(vertex, _COLORS) else _first(face, _COLORS)


def _colors(vertex: _Element, face: _Element, number: I64, sizes: I64) -> F64 | None:
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


def _unused(content: _Elements) -> list[str]:
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

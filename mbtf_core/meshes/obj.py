"""Wavefront OBJ: polygons with texture coordinates, colors of vertices, and materials of ``.mtl`` files."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import InputError
from mbtf_core.meshes.companions import Companions
from mbtf_core.meshes.content import (
    F64,
    MeshContent,
    MeshShape,
    groups_of,
    parse,
    read_bytes,
    with_colors,
    words_per_line,
)
from mbtf_core.meshes.mtl import MtlMaterial, as_text, material_values, read_mtl
from mbtf_core.meshes.polygons import CROSSING, triangulate
from mbtf_core.paths import suggest_name

I64 = NDArray[np.int64]
# Numbers of a vertex: its position and its color.
_MOST = 6
# Elements that are no polygons.
_OTHERS = {b"l": "lines", b"p": "points", b"curv": "curves", b"curv2": "curves", b"surf": "curved surfaces"}


def read_obj(path: Path) -> MeshContent:
    """Read an OBJ file; an InputError where it is none, has no triangles, or a polygon has corners that it
    lacks.

    There is a shape for the triangles of each material, and another one for those of them that lack texture
    coordinates. Colors of vertices are sRGB, as programs write them, and multiply those of the material.
    """
    lines = _Lines(path)
    positions, colors = lines.positions()
    uv, normals = lines.vectors(b"vt", 2), lines.vectors(b"vn", 3)
    corners, sizes, run = lines.corners((positions, uv, normals))
    triangles, polygon, crossing = triangulate(positions[corners[:, 0]], sizes)
    if not len(triangles):
        raise InputError("has no triangles", where=path)
    companions = Companions(path)
    materials = _Materials(path, lines.libraries, companions)
    material, of_object = lines.runs[run[polygon], 4:].T
    # Triangles of one material, without and with texture coordinates.
    shapes = []
    for group in groups_of(2 * material + (corners[triangles, 1] >= 0).all(axis=1)):
        name, part = lines.materials[material[group[0]]], lines.objects[of_object[group[0]]]
        values, faults = materials.of(name)
        arrays = _arrays(corners[triangles[group]], positions, colors, uv, normals)
        if name and part and arrays["uv"] is None and len(uv):
            # Where only some triangles lack texture coordinates, people look for their object.
            name = f"{part}, {name}"
        shape = MeshShape(name or part or path.name, **arrays, values=values, faults=faults)
        shapes.append(with_colors(shape, path, materials.warnings))
    warnings = [*lines.warnings, *materials.all_warnings(), *companions.warnings]
    if crossing:
        warnings.append(CROSSING.format(crossing))
    return MeshContent(shapes, companions.files, None, warnings)


class _Lines:
    """Statements of an OBJ file.

    Attributes
    ----------
    rows : lines without their keyword, of ``v``, ``vt``, ``vn`` and ``f``
    runs : (r, 6) of polygons that follow one another: number of the first one; vertices, texture coordinates
        and normals so far; material and object
    materials, objects : their names; the first one is that of polygons without any
    libraries : what follows ``mtllib``
    """

    def __init__(self, path: Path) -> None:
        data = read_bytes(path)
        if b"\0" in data:
            raise InputError("is not an OBJ file: it is no text", where=path)
        # A backslash continues a line in the next one. Old files end lines with a carriage return.
        data = re.sub(rb"\\\r?\n", b" ", data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n"))
        self.path, self.lines = path, data.replace(b"\r", b"\n").split(b"\n")
        self.rows: dict[bytes, list[bytes]] = {b"v": [], b"vt": [], b"vn": [], b"f": []}
        self.materials, self.objects, self.libraries = [""], [""], list[str]()
        self.warnings: list[str] = []
        runs: list[tuple[int, ...]] = []
        known: dict[str, int] = {"": 0}
        material, faces, others = 0, self.rows[b"f"], set[str]()
        continues = False
        for line in self.lines:
            words = line.split(None, 1)
            if len(words) < 2:
                continue
            word, rest = words
            if word == b"f":
                if not continues:
                    counts = (len(self.rows[name]) for name in (b"v", b"vt", b"vn"))
                    runs.append((len(faces), *counts, material, len(self.objects) - 1))
                    continues = True
                faces.append(rest)
                continue
            rows = self.rows.get(word)
            if rows is not None:
                rows.append(rest)
                continues = False
            elif word in (b"usemtl", b"o", b"g", b"mtllib"):
                name = as_text(rest).strip()
                continues = False
                if word == b"usemtl":
                    material = known.setdefault(name, len(known))
                elif word == b"mtllib":
                    self.libraries.append(name)
                else:
                    self.objects.append(name)
            elif word in _OTHERS:
                others.add(_OTHERS[word])
        self.materials = list(known)
        self.runs = np.array(runs, np.int64).reshape(-1, 6)
        if b"#MRGB " in data:
            others.add("colors of ZBrush")
        self.warnings = [f"its {', '.join(sorted(others))} are not used"] if others else []

    def positions(self) -> tuple[F64, F64 | None]:
        """Vertices (n, 3) and their linear colors, white where some have none."""
        table, counts = self._table(b"v")
        bad = ~np.isin(counts, (3, 4, 6))
        if bad.any():
            raise self._fault(b"v", bad, "a vertex has x, y, z and may have w, or r, g and b")
        positions, colored = table[:, :3], counts == 6
        if not colored.any():
            return positions, None
        if not colored.all():
            self.warnings.append(
                f"{np.count_nonzero(~colored):,} of its vertices have no color: they are white"
            )
        colors = np.where(colored[:, None], table[:, 3:], 1.0)
        return positions, np.asarray(srgb_to_linear(colors), np.float64)

    def vectors(self, keyword: bytes, count: int) -> F64:
        """Texture coordinates or normals (n, count); those that are left out are 0."""
        return self._table(keyword)[0][:, :count]

    def corners(self, vectors: tuple[F64, F64, F64]) -> tuple[I64, I64, I64]:
        """Numbers (c, 3) of the vertex, of the texture coordinates and of the normal at all corners of
        polygons, -1 for none; number of corners, and run, of each polygon."""
        text = _joined(self.rows[b"f"])
        sizes = words_per_line(text)
        polygon = np.repeat(np.arange(len(sizes)), sizes)
        indices = _indices(text, len(polygon))
        if indices is None:
            bad = np.array([_indices(_joined([row]), None) is None for row in self.rows[b"f"]])
            raise self._fault(b"f", bad, "its corners are no numbers with '/' between them")
        run = np.repeat(np.arange(len(self.runs)), np.diff(self.runs[:, 0], append=len(sizes)))
        for column, (what, found) in enumerate(
            zip(("vertices", "texture coordinates", "normals"), vectors, strict=True)
        ):
            number = indices[:, column]
            counted = self.runs[run[polygon], 1 + column] + number
            # Negative numbers count backward from the last one before the polygon.
            placed = np.where(number < 0, counted, number - 1)
            wrong = (placed >= len(found)) | (placed < 0) & (number != 0)
            if column == 0:
                wrong |= number == 0
            if wrong.any():
                bad = np.bincount(polygon[wrong], minlength=len(sizes)) > 0
                raise self._fault(b"f", bad, f"it has {what} that the file lacks; there are {len(found):,}")
            indices[:, column] = placed
            if column:
                # Vectors that are no numbers count as missing.
                usable = np.append(np.isfinite(found).all(axis=1), False)
                indices[~usable[placed], column] = -1
        return indices, sizes, run

    def _table(self, keyword: bytes) -> tuple[F64, I64]:
        """Numbers (n, 6) of the statements of a keyword, 0 for those that are left out, and how many each
        has."""
        text = _joined(self.rows[keyword])
        numbers, counts = parse(text, np.float64), words_per_line(text)
        if numbers is None or len(numbers) != counts.sum():
            rows = [parse(_joined([row]), np.float64) for row in self.rows[keyword]]
            bad = np.array([found is None or len(found) != n for found, n in zip(rows, counts, strict=True)])
            raise self._fault(keyword, bad, "it has words that are no numbers")
        if (counts > _MOST).any():
            raise self._fault(keyword, counts > _MOST, f"it has more than {_MOST} numbers")
        table = np.zeros((len(counts), _MOST))
        table[np.arange(_MOST) < counts[:, None]] = numbers
        return table, counts

    def _fault(self, keyword: bytes, bad: NDArray[np.bool_], what: str) -> InputError:
        """The error of the first bad statement of a keyword."""
        left = int(np.argmax(bad))
        for number, line in enumerate(self.lines, 1):
            words = line.split(None, 1)
            if len(words) == 2 and words[0] == keyword:
                if left == 0:
                    shown = as_text(line.strip()[:60])
                    return InputError(f"'{shown}': {what}", where=f"{self.path}, line {number}")
                left -= 1
        return InputError(what, where=self.path)


class _Materials:
    """Materials of an OBJ file by name, read when one is used."""

    def __init__(self, path: Path, libraries: Iterable[str], companions: Companions) -> None:
        self.path, self.companions = path, companions
        self.warnings: list[str] = []
        self._found: dict[str, MtlMaterial] = {}
        self._faults: list[InputError] = []
        self._remarks: dict[str, list[str]] = {}
        self._names: list[str] = []
        for text in libraries:
            for name in self._files(text):
                self._names.append(name)
                try:
                    read_mtl(companions.find(name), self._found, self.warnings)
                except InputError as fault:
                    self._faults.append(fault)
                    self.warnings.append(fault.what)

    def _files(self, text: str) -> list[str]:
        """Names of files, which may have blanks, after one another."""
        try:
            self.companions.find(text.strip('"'))
        except InputError:
            return re.findall(r"\S.*?\.mtl(?=\s|$)", text, re.IGNORECASE) or [text.strip('"')]
        return [text.strip('"')]

    def of(self, name: str) -> tuple[dict[str, Any], dict[str, InputError]]:
        """(values, faults) of a material, as of :class:`~mbtf_core.meshes.content.MeshShape`."""
        if name in self._found:
            values, faults, remarks = material_values(self._found[name], self.companions)
            for remark in remarks:
                self._remarks.setdefault(remark, []).append(name)
            return values, faults
        if not name:
            if self._names:
                self.warnings.append("some of its triangles have no material")
            return {}, {}
        if not self._names:
            self.warnings.append(f"its material '{name}' is not defined: it names no .mtl file")
            return {}, {}
        what = f"its material '{name}' is not defined in {', '.join(self._names)}"
        if self._faults:
            what = f"its material '{name}' is not defined: {self._faults[0].what}"
        hint = suggest_name(name, list(self._found)) or "add it, or give base_color in a material.yaml"
        return {}, {"base_color": InputError(what, where=self.path, hint=hint)}

    def all_warnings(self) -> list[str]:
        """Warnings, one for all materials that share it."""
        out = list(dict.fromkeys(self.warnings))
        for remark, names in self._remarks.items():
            names = list(dict.fromkeys(names))
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            out.append(f"material {', '.join(map(repr, names[:3]))}{more}: {remark}")
        return out


def _joined(rows: list[bytes]) -> bytes:
    """Lines without comments, each with its line break."""
    text = b"\n".join([*rows, b""])
    return re.sub(rb"#[^\n]*", b"", text) if b"#" in text else text


def _indices(text: bytes, count: int | None) -> I64 | None:
    """Numbers (count, 3) of corners ``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``, 0 for what is left out; None
    where they have another form."""
    text = text.replace(b"//", b"/0/")
    if count:
        widths = {word.count(b"/") + 1 for word in text.split()}
        width = max(widths)
        numbers = parse(text.replace(b"/", b" "), np.int64) if len(widths) == 1 and width <= 3 else None
        if numbers is not None and len(numbers) == count * width:
            out = np.zeros((count, 3), np.int64)
            out[:, :width] = numbers.reshape(count, width)
            return out
    try:
        rows = [[int(number or 0) for number in word.split(b"/")] for word in text.split()]
        if any(len(row) > 3 for row in rows):
            return None
        return np.array([[*row, 0, 0][:3] for row in rows], np.int64).reshape(-1, 3)
    except (ValueError, OverflowError):
        return None


def _arrays(corners: I64, positions: F64, colors: F64 | None, uv: F64, normals: F64) -> dict[str, Any]:
    """Arrays of a shape whose triangles have corners (m, 3, 3): each combination that is used is a vertex."""
    vertex, texture, normal = corners.reshape(-1, 3).T
    key, textured, smooth = vertex, bool((texture >= 0).all()), bool((normal >= 0).all())
    for used, number, count in ((textured, texture, len(uv)), (smooth, normal, len(normals))):
        # Programs often count all of them alike.
        if used and not np.array_equal(number, vertex):
            # Numbers of combinations stay small, so that their products do not overflow.
            key = np.unique(key, return_inverse=True)[1] * count + number
    _, first, faces = np.unique(key, return_index=True, return_inverse=True)
    return {
        "vertices": positions[vertex[first]],
        "faces": faces.reshape(-1, 3),
        "uv": uv[texture[first]] if textured else None,
        "colors": None if colors is None else colors[vertex[first]],
        "normals": normals[normal[first]] if smooth else None,
    }

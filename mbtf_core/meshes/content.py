"""What a file of triangles holds: numbers, shapes, what they reflect, and the files that it refers to."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.paths import opened

F64 = NDArray[np.float64]
Wrap = Literal["repeat", "mirror", "clamp"]
# Triangles of one tile: with Mitsuba's and Embree's own data they take about 150 bytes each.
MOST_TRIANGLES = 20_000_000
I64 = NDArray[np.int64]


@dataclass(frozen=True)
class Texture:
    """An image that is placed on a shape by its texture coordinates.

    Attributes
    ----------
    pixels : (h, w) or (h, w, 3), linear Rec.709 colors or numbers, factors of the file not applied. Row 0 is
        the top, v → 1.
    wrap : what lies beyond [0, 1] along u and along v
    nearest : whether the file asks for texels without interpolation
    to_uv : (2, 3), texture coordinates (v up) of the image from (u, v, 1) of the shape (v up)
    """

    pixels: NDArray[np.float32]
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    nearest: bool = False
    to_uv: F64 = field(default_factory=lambda: np.eye(2, 3))


# A number, a linear color (3,), or a texture with the factor on it.
Value = float | F64 | tuple[Texture, float | F64]


def numbers_of(value: Value) -> NDArray[np.floating[Any]]:
    """Numbers (...) or colors (..., 3) that a value takes, its factor applied."""
    if isinstance(value, tuple):
        texture, factor = value
        same = np.all(np.asarray(factor) == 1.0)
        return texture.pixels if same else texture.pixels * np.asarray(factor, np.float32)
    return np.asarray(value, np.float64)


def of_faces(values: F64, faces: NDArray[np.int64]) -> F64:
    """Those of the vertices' values (n, ...) that triangles (m, 3) use."""
    used = np.zeros(len(values), bool)
    used[faces] = True
    return values[used]


@dataclass(frozen=True)
class MeshShape:
    """Triangles of one material.

    Attributes
    ----------
    name : its name in the file
    vertices : (n, 3), positions in the file's units and axes, nodes of scenes applied
    faces : (m, 3), vertices of each triangle, counterclockwise seen from outside
    uv : (n, 2), texture coordinates, v up
    colors : (n, 3), linear Rec.709 factors of the vertices on the base color
    values : what the file says of its material, by role of a ``material.yaml`` (``base_color``,
        ``roughness``, …); defaults of the format included. A role that is missing was not given. ``opacity``
        may have an ``opacity_cutoff`` beside it, below which a point is a hole and above which it is opaque.
    faults : why a role cannot be read. The tile raises it unless the ``material.yaml`` gives the role.
    normals : (n, 3), unit normals of the vertices, which viewers shade with; tiles have those of their
        triangles
    """

    name: str
    vertices: F64
    faces: NDArray[np.int64]
    uv: F64 | None = None
    colors: F64 | None = None
    values: dict[str, Any] = field(default_factory=dict)
    faults: dict[str, InputError] = field(default_factory=dict)
    normals: F64 | None = None


def joined(shapes: Sequence[MeshShape]) -> tuple[F64, NDArray[np.int64]]:
    """Vertices (n, 3) and triangles (m, 3) of all shapes, one after the other."""
    starts = np.cumsum([0, *(len(shape.vertices) for shape in shapes[:-1])])
    faces = [shape.faces + start for shape, start in zip(shapes, starts, strict=True)]
    return np.concatenate([shape.vertices for shape in shapes]), np.concatenate(faces)


@dataclass(frozen=True)
class MeshContent:
    """All that was read from a file of triangles.

    Attributes
    ----------
    shapes : list of MeshShape
    files : files besides the first that were read, by the name that refers to them: buffers, materials,
        images
    up : {"y", "z"} or None, axis that points up by the definition of the format; None where it has none
    warnings : what the file has that is not used, one line each, without its path
    """

    shapes: list[MeshShape]
    files: dict[str, Path] = field(default_factory=dict)
    up: Literal["y", "z"] | None = None
    warnings: list[str] = field(default_factory=list)


def triangle_areas(points: F64, faces: NDArray[np.int64]) -> F64:
    """Areas of triangles in space, or signed ones in the plane."""
    a, b = (points[faces[:, k]] - points[faces[:, 0]] for k in (1, 2))
    if points.shape[1] == 2:
        return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return 0.5 * np.linalg.norm(np.cross(a, b), axis=1)


def groups_of(key: I64) -> list[I64]:
    """Indices that share a value, for each of the values in ascending order."""
    order = np.argsort(key, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(key[order])) + 1)


def with_colors(shape: MeshShape, path: Path, warnings: list[str]) -> MeshShape:
    """A shape of a file whose colors of vertices go with its base color; warnings are added.

    Images take precedence over colors of vertices; colors that are all white are none.
    """
    colors, base = shape.colors, shape.values.get("base_color")
    if colors is None or np.all(colors == 1.0):
        return replace(shape, colors=None)
    if isinstance(base, tuple):
        warnings.append(f"'{shape.name}' has an image: the colors of its vertices are not used")
        return replace(shape, colors=None)
    if not (np.isfinite(colors).all() and colors.min() >= 0.0 and colors.max() <= 1.0):
        fault = InputError(
            f"'{shape.name}' has colors of vertices outside [0, 1]",
            where=path,
            hint="correct them, or give base_color in a material.yaml",
        )
        return replace(shape, colors=None, faults={**shape.faults, "base_color": fault})
    if base is not None and np.any(base != 1.0):
        warnings.append(f"'{shape.name}': its color multiplies the colors of its vertices")
    return replace(shape, values={"base_color": np.ones(3), **shape.values})


def parse(text: bytes, kind: type) -> NDArray[Any] | None:
    """Numbers, np.float64 or np.int64, between blanks and line breaks; None where one word is none."""
    if not text.strip():
        return np.zeros(0, kind)
    with warnings.catch_warnings():
        # Older versions of NumPy warn of words that are no numbers.
        warnings.simplefilter("error")
        try:
            return np.fromstring(text, kind, sep=" ")
        except (ValueError, DeprecationWarning):
            return None


def words_per_line(text: bytes) -> NDArray[np.int64]:
    """Number of words of each line."""
    return np.array([len(line.split()) for line in text.splitlines()], np.int64)


def read_bytes(path: Path) -> bytes:
    """Content of a file; an InputError where it cannot be read, or is empty."""
    with opened(path) as stream:
        data = stream.read()
    if not data:
        raise InputError("is empty", where=path)
    return data

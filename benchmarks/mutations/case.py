"""An input with mutations, what a right reading of it is, and the parts that makers share."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@dataclass
class Case:
    """An input.

    `check` says whether a reading, the reader's result, is right, and None where nobody knows; `refuse` that
    only a refusal is right; `tell` are words, one of which a warning must have, even of a right reading where
    not `unless`. An input is `valid` that follows its format and uses only what is documented as read.
    """

    path: Path
    check: Callable[[Any], bool | None] = lambda _: None
    refuse: bool = False
    tell: tuple[str, ...] = ()
    unless: bool = False
    valid: bool = False


@dataclass
class Draws:
    """Random choices, described as they are made; `number` is that of the input."""

    rng: np.random.Generator
    number: int = 0
    words: list[str] = field(default_factory=list)

    def chance(self, share: float, words: str = "") -> bool:
        """Whether something is done, in a share of all cases."""
        done = bool(self.rng.random() < share)
        if done and words:
            self.words.append(words)
        return done

    def pick(self, options: Any, name: str = "") -> Any:
        """One of several options."""
        chosen = list(options)[int(self.rng.integers(len(options)))]
        if name:
            self.words.append(f"{name} {chosen}")
        return chosen

    def fault(self, share: float, *options: str) -> str:
        """One of several faults in a share of all cases, else nothing."""
        return str(self.pick(options, "fault")) if self.chance(share) else ""

    def between(self, low: float, high: float) -> float:
        """A number with three digits."""
        return float(f"{self.rng.uniform(low, high):.3g}")


Maker = Callable[[Draws, Path], Case]


def damaged(maker: Maker) -> Maker:
    """A maker of the inputs of another one with damaged bytes, of which nobody knows the right reading."""

    def make(d: Draws, folder: Path) -> Case:
        case = maker(d, folder)
        files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != "material.yaml"]
        file = d.pick(files)
        data = bytearray(file.read_bytes() or b" ")
        at = int(d.rng.integers(len(data)))
        how = d.pick(("cut", "bits", "ones", "zeros", "twice"), f"{file.name}:")
        if how == "cut":
            del data[at:]
        elif how == "bits":
            for place in d.rng.integers(len(data), size=3):
                data[place] ^= 1 << int(d.rng.integers(8))
        elif how == "twice":
            data[at:at] = data[at : at + 16]
        else:
            data[at : at + 4] = b"\xff\xff\xff\x7f" if how == "ones" else bytes(4)
        file.write_bytes(data)
        return Case(case.path)

    return make


def linear(codes: Any) -> F64:
    """Linear values of sRGB values in [0, 1] (IEC 61966-2-1)."""
    x = np.asarray(codes, np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0) + 0.055) / 1.055) ** 2.4)


def quarters(rng: np.random.Generator) -> NDArray[np.uint8]:
    """8-bit codes (16, 16, 3): four quarters of different colors."""
    return np.kron(rng.integers(20, 250, (2, 2, 3)), np.ones((8, 8, 1))).astype(np.uint8)


def encoded(codes: NDArray[Any], kind: str = "PNG", **options: Any) -> bytes:
    """An image file of 8-bit codes; JPEG of its best quality."""
    from PIL import Image

    stream = io.BytesIO()
    if kind == "JPEG":
        options |= {"quality": 100, "subsampling": 0}
    Image.fromarray(codes).save(stream, kind, **options)
    return stream.getvalue()


@dataclass
class Look:
    """A mesh as its maker wrote it, z up, and what it reflects; colors are linear.

    `to_uv` (2, 3) takes the file's coordinates to those of the texture, v up; `more` are other parameters,
    numbers or textures (H, W, 1) without `to_uv`.
    """

    vertices: F64
    faces: NDArray[np.int_]
    uv: F64
    factor: F64 = field(default_factory=lambda: np.ones(3))
    colors: F64 | None = None
    texture: F64 | None = None
    to_uv: F64 = field(default_factory=lambda: np.eye(2, 3))
    wrap: tuple[str, str] = ("repeat", "repeat")
    nearest: bool = False
    more: dict[str, Any] = field(default_factory=dict)

    def at(self, x: float, y: float) -> dict[str, Any]:
        """Height below the highest point, color and other parameters at a place in [0, 1]²."""
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        number, weights, z = hit(self.vertices, self.faces, *(low + (x, y, 0) * (high - low))[:2])
        color, (u, v) = self.factor, weights @ self.uv[self.faces[number]]
        if self.colors is not None:
            color = color * (weights @ self.colors[self.faces[number]])
        if self.texture is not None:
            s, t = self.to_uv @ (u, v, 1)
            color = color * looked_up(self.texture, s, t, self.wrap, self.nearest)
        more = {k: looked_up(m, u, v) if np.ndim(m) else m for k, m in self.more.items()}
        return {"z": (z - high[2]) / (high - low)[0], "base_color": color, **more}

    def is_read_as(self, tile: Any) -> bool:
        """Whether a mesh tile is the same, off the edges of triangles and quarters."""
        for x, y in ((0.23, 0.19), (0.81, 0.28), (0.33, 0.71), (0.68, 0.87), (0.11, 0.56)):
            found = seen(tile, x, y * tile.aspect)
            for name, value in self.at(x, y).items():
                if np.abs(found.get(name, 0.0) - value).max() > (1e-4 if name == "z" else 4e-3):
                    return False
        return True


def looked_up(
    texture: F64, u: float, v: float, wrap: tuple[str, str] = ("repeat", "repeat"), nearest: bool = False
) -> F64:
    """Value of a texture (H, W, C) at (u, v), v up, as OpenGL defines it: bilinear, or the nearest texel."""
    rows, columns = texture.shape[:2]
    x, y = u * columns - 0.5, (1.0 - v) * rows - 0.5
    if nearest:
        x, y = math.floor(x + 0.5), math.floor(y + 0.5)
    total = np.zeros(texture.shape[2])
    for j in (math.floor(y), math.floor(y) + 1):
        for i in (math.floor(x), math.floor(x) + 1):
            weight = max(1 - abs(x - i), 0) * max(1 - abs(y - j), 0)
            total += weight * texture[_in_range(j, rows, wrap[1]), _in_range(i, columns, wrap[0])]
    return total


def _in_range(i: int, size: int, how: str) -> int:
    if how == "clamp":
        return min(max(i, 0), size - 1)
    return min(i % (2 * size), 2 * size - 1 - i % (2 * size)) if how == "mirror" else i % size


def patch(rng: np.random.Generator) -> tuple[F64, NDArray[np.int_]]:
    """Vertices (16, 3) and triangles (18, 3) of a bumpy unit square whose border is level, z up."""
    x, y = (a.ravel() / 3.0 for a in np.meshgrid(np.arange(4), np.arange(4)))
    inside = (x > 0) & (x < 1) & (y > 0) & (y < 1)
    z = np.where(inside, np.round(rng.uniform(-0.2, 0.2, 16), 2), 0.0)
    start = np.array([[0, 1, 5], [0, 5, 4]])
    faces = np.concatenate([start + j * 4 + i for j in range(3) for i in range(3)])
    return np.stack([x, y, z], axis=1), faces


def hit(vertices: F64, faces: NDArray[Any], x: float, y: float) -> tuple[int, F64, float]:
    """(triangle, barycentric weights, z) of the highest triangle over (x, y); z is -inf without one."""
    found = 0, np.ones(3), -np.inf
    for number, (a, b, c) in enumerate(vertices[faces]):
        sides = np.array([(b - a)[:2], (c - a)[:2]]).T
        if abs(np.linalg.det(sides)) < 1e-14:
            continue
        s, t = np.linalg.solve(sides, (x, y) - a[:2])
        weights = np.array([1 - s - t, s, t])
        z = float(weights @ (a[2], b[2], c[2]))
        if weights.min() > -1e-9 and z > found[2]:
            found = number, weights, z
    return found


def seen(tile: Any, x: float, y: float) -> dict[str, Any]:
    """z, color and other parameters of a mesh tile, as its own Mitsuba dictionaries describe it."""
    import mitsuba as mi

    number, weights, z = hit(tile.vertices, tile.faces, x, y)
    at = mi.SurfaceInteraction3f()
    u, v = weights @ tile.uv[tile.faces[number]]
    at.uv = mi.Point2f(u, 1.0 - v)  # row 0 of bitmaps is at v = 0 there
    values: dict[str, Any] = {"z": z}
    for name, value in tile.surface()[int(tile.part[number])].items():
        if isinstance(value, dict):
            texture = mi.load_dict(value)
            value = np.array(texture.eval(at)).ravel() if name.endswith("color") else texture.eval_1(at)
        if not isinstance(value, str):
            values[name] = np.asarray(value)
    if values.get("opacity_cutoff", 0.0) != 0:
        values["opacity"] = values["opacity"] >= values["opacity_cutoff"]
    return values

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
Rng = np.random.Generator
# What a check finds: whether a reading is right, and None where nobody knows.
Check = Callable[[Any], bool | None]


@dataclass
class Case:
    """An input.

    Attributes
    ----------
    path : Path
        What is given to the reader.
    text : str
        Its mutations in words.
    check : Check
        Whether a reading, the reader's result, is right.
    refuse : bool
        Whether only a refusal is right.
    tell : tuple of str
        Words, one of which a warning must have.
    unless : bool
        Whether nothing needs to be said where the reading is right.
    valid : bool
        Whether the input follows its format and uses only what is documented as read.
    """

    path: Path
    text: str
    check: Check = lambda _: None
    refuse: bool = False
    tell: tuple[str, ...] = ()
    unless: bool = False
    valid: bool = False


@dataclass
class Draws:
    """Random choices, described as they are made."""

    rng: Rng
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

    def number(self, low: float, high: float, name: str = "") -> float:
        """A number with three digits."""
        drawn = float(f"{self.rng.uniform(low, high):.3g}")
        if name:
            self.words.append(f"{name} {drawn:g}")
        return drawn


def linear(codes: Any) -> F64:
    """Linear values of sRGB values in [0, 1] (IEC 61966-2-1)."""
    x = np.asarray(codes, np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0) + 0.055) / 1.055) ** 2.4)


def quarters(rng: Rng, size: int = 16) -> NDArray[np.uint8]:
    """8-bit codes (size, size, 3): four quarters of different colors."""
    colors = rng.integers(20, 250, (2, 2, 3)).astype(np.uint8)
    return np.repeat(np.repeat(colors, size // 2, axis=0), size // 2, axis=1)


def encoded(codes: NDArray[Any], kind: str = "PNG", **options: Any) -> bytes:
    """An image file of 8-bit codes."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(codes).save(stream, kind, **options)
    return stream.getvalue()


def looked_up(texture: F64, u: float, v: float, wrap: tuple[str, str], nearest: bool = False) -> F64:
    """Value of a texture (H, W, 3) at (u, v), v up, as OpenGL defines it: bilinear, or the nearest texel."""
    rows, columns = texture.shape[:2]
    x, y = u * columns - 0.5, (1.0 - v) * rows - 0.5
    if nearest:
        x, y = math.floor(x + 0.5), math.floor(y + 0.5)
    total = np.zeros(texture.shape[2])
    for j in (math.floor(y), math.floor(y) + 1):
        for i in (math.floor(x), math.floor(x) + 1):
            weight = (1 - abs(x - i)) * (1 - abs(y - j))
            if weight > 0:
                total += weight * texture[_wrapped(j, rows, wrap[1]), _wrapped(i, columns, wrap[0])]
    return total


def _wrapped(i: int, size: int, how: str) -> int:
    if how == "clamp":
        return min(max(i, 0), size - 1)
    if how == "mirror":
        i %= 2 * size
        return i if i < size else 2 * size - 1 - i
    return i % size


# Places (x, y) in the tile at which readings are compared, off all edges of triangles and quarters.
PLACES = ((0.23, 0.19), (0.81, 0.28), (0.33, 0.71), (0.68, 0.87), (0.11, 0.56))


def patch(rng: Rng) -> tuple[F64, NDArray[np.int64]]:
    """Vertices (16, 3) and triangles (18, 3) of a bumpy unit square whose border is level, z up."""
    x, y = (a.ravel() / 3.0 for a in np.meshgrid(np.arange(4), np.arange(4)))
    inside = (x > 0) & (x < 1) & (y > 0) & (y < 1)
    z = np.where(inside, np.round(rng.uniform(-0.2, 0.2, 16), 2), 0.0)
    start = np.array([[0, 1, 5], [0, 5, 4]])
    faces = np.concatenate([start + j * 4 + i for j in range(3) for i in range(3)])
    return np.stack([x, y, z], axis=1), faces


def hit(vertices: F64, faces: NDArray[Any], x: float, y: float) -> tuple[int, F64, float] | None:
    """(triangle, barycentric weights, z) of the highest triangle over (x, y); None where there is none."""
    found = None
    for number, (a, b, c) in enumerate(vertices[faces]):
        sides = np.array([(b - a)[:2], (c - a)[:2]]).T
        if abs(np.linalg.det(sides)) < 1e-14:
            continue
        s, t = np.linalg.solve(sides, (x, y) - a[:2])
        if s < -1e-9 or t < -1e-9 or s + t > 1 + 1e-9:
            continue
        weights = np.array([1 - s - t, s, t])
        z = float(weights @ (a[2], b[2], c[2]))
        if found is None or z > found[2]:
            found = number, weights, z
    return found


def seen(tile: Any) -> list[tuple[float, F64, dict[str, F64]] | None]:
    """(z, color, other parameters) of a mesh tile at PLACES, as its own Mitsuba dictionaries describe it."""
    import mitsuba as mi

    surfaces = tile.surface()
    out: list[Any] = []
    for x, y in PLACES:
        found = hit(tile.vertices, tile.faces, x, y * tile.aspect)
        if found is None:
            out.append(None)
            continue
        number, weights, z = found
        at = mi.SurfaceInteraction3f()
        u, v = weights @ tile.uv[tile.faces[number]]
        at.uv = mi.Point2f(u, 1.0 - v)  # row 0 of bitmaps is at v = 0 there
        values = {}
        for name, value in surfaces[int(tile.part[number])].items():
            if isinstance(value, dict):
                texture = mi.load_dict(value)
                color = name.endswith("color")
                values[name] = np.array(texture.eval(at)).ravel() if color else np.array(texture.eval_1(at))
            elif not isinstance(value, str):
                values[name] = np.asarray(value)
        if "opacity" in values:
            cutoff = values.get("opacity_cutoff", 0.0)
            values["opacity"] = np.where(cutoff == 0, values["opacity"], values["opacity"] >= cutoff)
        out.append((z, values.pop("base_color"), values))
    return out


def agree(tile: Any, expected: list[tuple[float, F64, dict[str, Any]]], tolerance: float = 2e-3) -> bool:
    """Whether a mesh tile has the expected heights (its highest point is 0), colors and parameters."""
    for found, wanted in zip(seen(tile), expected, strict=True):
        if found is None or abs(found[0] - wanted[0]) > 1e-4:
            return False
        if np.abs(found[1] - wanted[1]).max() > tolerance:
            return False
        for name, value in wanted[2].items():
            if np.abs(found[2].get(name, np.zeros(())) - value).max() > tolerance:
                return False
    return True


def damaged(data: bytes, draws: Draws, start: int = 0) -> bytes:
    """The bytes, cut, extended, or with some replaced from `start` on."""
    rng, out = draws.rng, bytearray(data)
    how = draws.pick(("cut", "flip", "ones", "zeros", "twice"), "bytes")
    at = int(rng.integers(start, len(out)))
    if how == "cut":
        return bytes(out[:at])
    if how == "flip":
        for _ in range(int(rng.integers(1, 4))):
            out[int(rng.integers(start, len(out)))] ^= 1 << int(rng.integers(8))
    elif how == "twice":
        out[at:at] = out[at : at + 16]
    else:
        out[at : at + 4] = b"\xff\xff\xff\x7f" if how == "ones" else bytes(4)
    return bytes(out)

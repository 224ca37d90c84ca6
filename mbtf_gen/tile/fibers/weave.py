"""Woven and knitted cloth: the center lines of its yarns, and periodic yarn patterns.

Warps and wefts undulate about the plane between them. At a crossing the upper yarn lies on the lower one.
Between crossings a yarn rises and falls like a cosine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.paths import opened
from mbtf_gen.tile.fibers.curve_file import lines, numbers
from mbtf_gen.tile.fibers.curves import F64, LEAST_POINTS, Curve
from mbtf_gen.tile.fibers.draft import Draft

# Points per crossing, and per stitch, of a center line.
_PER_CROSSING, _PER_STITCH = 4, 24
# Loops of a stockinette stitch, in stitches: how far they lean over, how high they are, how deep.
_LEAN, _TALL, _DEEP = 0.24, 0.64, 0.16


def woven_lines(draft: Draft, aspect: float, apart: float | F64) -> tuple[list[Curve], list[Curve]]:
    """Center lines of warps, and of wefts from v → 1, of one tile of a draft (rows, columns).

    `apart` is their distance at crossings, one or of each (rows, columns), in tile widths.
    """
    rows, columns = draft.shape
    z = np.where(draft, 0.5, -0.5) * apart
    x, y = (np.arange(columns) + 0.5) / columns, aspect * (1.0 - (np.arange(rows) + 0.5) / rows)
    # Warps run from v = 0 up: from the last row to row 0.
    warps = [
        _undulating(np.column_stack([np.full(rows, x[k]), y[::-1], z[::-1, k]]), np.array([0.0, aspect, 0.0]))
        for k in range(columns)
    ]
    wefts = [
        _undulating(np.column_stack([x, np.full(columns, y[k]), -z[k]]), np.array([1.0, 0.0, 0.0]))
        for k in range(rows)
    ]
    return warps, wefts


def _undulating(crossings: F64, shift: F64) -> Curve:
    """A center line through crossings (n, 3)."""
    n = len(crossings)
    t = np.arange(n * _PER_CROSSING) / _PER_CROSSING
    k = t.astype(int)
    f = 0.5 - 0.5 * np.cos(np.pi * (t - k))
    z = crossings[:, 2]
    points = crossings[0] + t[:, None] / n * shift
    points[:, 2] = z[k] + f * (z[(k + 1) % n] - z[k])
    return Curve.through(points, 0.0, shift)


def knitted_lines(stitches: int, rows: int, aspect: float) -> list[Curve]:
    """Center lines of a stockinette of `rows` yarns of `stitches` loops each.

    A yarn is ``x = t + a sin 2t``, ``y = h cos t``, ``z = -d cos 2t``, with 2π per stitch: it leans over
    itself, and its loops pass through those of the row below.
    """
    t = 2.0 * np.pi * np.arange(_PER_STITCH * stitches) / _PER_STITCH
    wale, course = 1.0 / stitches, aspect / rows
    out = []
    for row in range(rows):
        x = (t / (2.0 * np.pi) + _LEAN * np.sin(2.0 * t)) * wale
        y = (row + 0.5) * course + _TALL * max(wale, course) * np.cos(t)
        z = -_DEEP * wale * np.cos(2.0 * t)
        out.append(Curve.through(np.column_stack([x, y, z]), 0.0, np.array([1.0, 0.0, 0.0])))
    return out


_SECTIONS = {"*pattern": 4, "*Q": 4, "*E": 4}
# Periods that a yarn may reach over.
_MOST_PERIODS = 16
# Vertices of a pattern; each has some hundred segments of fibers.
_MOST_VERTICES = 100_000


@dataclass(frozen=True)
class YarnLoop:
    """Center line of one yarn.

    Attributes
    ----------
    points : (n, 3), vertices in units of the pattern's width, without jumps at its borders
    shift : (2,), periods from the start to the end: (1, 0) for a yarn along x, (0, 0) for a ring
    """

    points: F64
    shift: NDArray[np.int_]


@dataclass(frozen=True)
class YarnPattern:
    """Yarns of one period, in units of its width.

    Attributes
    ----------
    aspect : height of the period over its width
    radius : radius of the yarns
    yarns : tuple of YarnLoop
    """

    aspect: float
    radius: float
    yarns: tuple[YarnLoop, ...]


def read_pattern(path: Path) -> YarnPattern:
    """Read a ``.pyp`` file.

    Raises
    ------
    InputError : the file is unreadable or truncated, a number is not finite, or edges do not form closed
        yarns
    """
    with opened(path) as stream:
        rows = _sections(stream, path)
    for name in _SECTIONS:
        if not rows.get(name):
            raise InputError(f"has no section '{name}'", where=path, hint="check that the file is complete")
    px, py, radius, _ = rows["*pattern"][0]
    if not (px > 0 and py > 0 and radius > 0):
        what = f"has the period {px:g} x {py:g} and the yarn radius {radius:g}: all must be positive"
        raise InputError(what, where=path)
    vertices = np.array(rows["*Q"])[:, :3]
    edges = np.array(rows["*E"])
    if (edges != np.round(edges)).any() or np.abs(edges).max() > _MOST_VERTICES:
        raise InputError("its section '*E' has numbers that are no indices", where=path)
    if np.abs(edges[:, 2:]).max() > _MOST_PERIODS or np.abs(vertices).max() > _MOST_PERIODS * max(px, py):
        raise InputError(f"its yarns reach over more than {_MOST_PERIODS} periods", where=path)
    loops = _loops(edges.astype(int), len(vertices), path)
    period = np.array([px, py])
    yarns = []
    for index, turns, shift in loops:
        if len(index) < LEAST_POINTS:
            raise InputError(f"a yarn has {len(index)} vertices, fewer than {LEAST_POINTS}", where=path)
        points = vertices[index].copy()
        points[:, :2] += turns * period
        following = np.concatenate([points[1:], points[:1] + np.append(shift * period, 0.0)])
        if not (np.linalg.norm(following - points, axis=1) > 0).all():
            raise InputError("two vertices of a yarn are at the same place", where=path)
        yarns.append(YarnLoop(points / px, shift))
    return YarnPattern(py / px, radius / px, tuple(yarns))


def _sections(stream: BinaryIO, path: Path) -> dict[str, list[list[float]]]:
    """Rows of numbers of the sections that are read."""
    rows: dict[str, list[list[float]]] = {}
    section = ""
    for number, line in lines(stream):
        words = line.split(b"#")[0].split()
        if not words:
            continue
        if words[0].startswith(b"*"):
            section = words[0].decode("latin-1")
            continue
        if section not in _SECTIONS:
            continue
        values = numbers(words)
        if len(values) != _SECTIONS[section] or not all(map(math.isfinite, values)):
            raise InputError(
                f"line {number} is not {_SECTIONS[section]} finite numbers",
                where=path,
                hint="check that the file is complete",
            )
        found = rows.setdefault(section, [])
        found.append(values)
        if len(found) > _MOST_VERTICES:
            raise InputError(
                f"has more than {_MOST_VERTICES:,} vertices",
                where=path,
                hint="save a smaller period, or fewer vertices",
            )
    return rows


def _loops(
    edges: NDArray[np.int_], count: int, path: Path
) -> list[tuple[NDArray[np.int_], NDArray[np.int_], NDArray[np.int_]]]:
    """(vertices, periods by which each is moved, shift of the whole) of each closed yarn."""
    if (edges[:, :2] < 0).any() or (edges[:, :2] >= count).any():
        raise InputError(f"an edge names a vertex beyond the {count} of the file", where=path)
    follower = np.full(count, -1)
    step = np.zeros((count, 2), int)
    follower[edges[:, 0]] = edges[:, 1]
    step[edges[:, 0]] = edges[:, 2:]
    if (
        len(edges) != count
        or (np.sort(edges[:, 0]) != np.arange(count)).any()
        or (np.sort(edges[:, 1]) != np.arange(count)).any()
    ):
        raise InputError(
            "its edges do not form closed yarns: each vertex must begin one edge and end one", where=path
        )
    seen = np.zeros(count, bool)
    out = []
    for start in range(count):
        if seen[start]:
            continue
        index, turns, here, moved = [], [], start, np.zeros(2, int)
        while not seen[here]:
            seen[here] = True
            index.append(here)
            turns.append(moved)
            moved = moved + step[here]
            here = int(follower[here])
        out.append((np.array(index), np.array(turns), moved))
    return out

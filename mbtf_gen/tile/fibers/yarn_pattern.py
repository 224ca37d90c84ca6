"""Periodic yarn patterns (``.pyp``): center lines of yarns that repeat with a rectangle.

Format of Sperl, Narain and Wojtan (ACM TOG 40(4), 2021), text: below ``*pattern`` the period and the yarn
radius, in meters; below ``*Q`` one vertex per line, ``x y z twist``; below ``*E`` one edge per line, ``i j dx
dy``: vertex j, moved by (dx, dy) periods, follows vertex i. Other sections are rest states of a simulation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_gen.tile.fibers.curves import F64, LEAST_POINTS

_SECTIONS = {"*pattern": 4, "*Q": 4, "*E": 4}
# Periods that a yarn may reach over.
_MOST_PERIODS = 16
# Vertices of a pattern, which bounds what a damaged file may claim.
_MOST_VERTICES = 10_000_000


@dataclass(frozen=True)
class YarnLoop:
    """Center line of one yarn.

    Attributes
    ----------
    points : (n, 3) float64 array
        Vertices in units of the pattern's width, without jumps at its borders.
    shift : (2,) int array
        Periods from the start to the end: (1, 0) for a yarn along x, (0, 0) for a ring.
    """

    points: F64
    shift: NDArray[np.int_]


@dataclass(frozen=True)
class YarnPattern:
    """Yarns of one period, in units of its width.

    Attributes
    ----------
    aspect : float
        Height of the period over its width.
    radius : float
        Radius of the yarns.
    width : float
        Width of the period in meters.
    yarns : tuple of YarnLoop
    """

    aspect: float
    radius: float
    width: float
    yarns: tuple[YarnLoop, ...]


def read_pattern(path: Path) -> YarnPattern:
    """Read a ``.pyp`` file.

    Raises
    ------
    InputError
        The file is unreadable or truncated, a number is not finite, or edges do not form closed yarns.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read as text: {error}", where=path) from None
    rows = _sections(text, path)
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
    return YarnPattern(py / px, radius / px, px, tuple(yarns))


def _sections(text: str, path: Path) -> dict[str, list[list[float]]]:
    """Rows of numbers of the sections that are read."""
    rows: dict[str, list[list[float]]] = {}
    section = ""
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        if words[0].startswith("*"):
            section = words[0]
            continue
        if section not in _SECTIONS:
            continue
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) != _SECTIONS[section] or not all(map(math.isfinite, values)):
            raise InputError(
                f"line {number} is not {_SECTIONS[section]} finite numbers",
                where=path,
                hint="check that the file is complete",
            )
        rows.setdefault(section, []).append(values)
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

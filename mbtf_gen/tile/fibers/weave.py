"""Woven and knitted cloth: drafts, periodic yarn patterns, and the center lines of their yarns.

A draft is a rectangle of crossings, row by row from the side ``v → 1``: ``X`` where the warp, which runs
along v, lies above, ``.`` where the weft does. Both sets of yarns undulate about the plane between them. At a
crossing the upper yarn lies on the lower one. Between crossings a yarn rises and falls like a cosine.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.paths import refuse_special
from mbtf_gen.tile.fibers.curves import F64, LEAST_POINTS, Curve

Draft = NDArray[np.bool_]

# Points per crossing, and per stitch, of a center line.
_PER_CROSSING, _PER_STITCH = 4, 24
# Most crossings along a side of a draft.
_MOST_YARNS = 1024
# Loops of a stockinette stitch, in stitches: how far they lean over, how high they are, how deep.
_LEAN, _TALL, _DEEP = 0.24, 0.64, 0.16


def plain() -> Draft:
    """Draft of the plain weave."""
    return basket(1)


def basket(n: int) -> Draft:
    """Draft of the basket weave of n × n yarns: a plain weave whose yarns are n side by side."""
    row, column = np.indices((2 * n, 2 * n)) // n
    return np.asarray((row + column) % 2 == 0)


def twill(over: int, under: int) -> Draft:
    """Draft of a twill: warps lie above `over` wefts and below `under`, one crossing further per yarn."""
    row, column = np.indices((over + under, over + under))
    return np.asarray((row + column) % (over + under) < over)


def satin(n: int, step: int) -> Draft:
    """Draft of a satin of n yarns: each warp lies below one weft in n, `step` crossings further per yarn.

    Raises
    ------
    InputError : the wefts' crossings would not be spread over the draft
    """
    if n < 5 or not 1 < step < n - 1 or np.gcd(n, step) != 1:
        raise InputError(
            f"a satin of {n} yarns has no step of {step}",
            hint="take 5 yarns or more, and a step from 2 to n - 2 that shares no factor with n",
        )
    row, column = np.indices((n, n))
    return np.asarray((row - step * column) % n != 0)


def parse_draft(text: str) -> Draft:
    """Draft of a name (``plain``, ``basket 2``, ``twill 3/1``, ``satin 5/2``) or of rows of ``X`` and ``.``.

    Raises
    ------
    InputError : neither of the two
    """
    words = text.split()
    counts = [int(word) for word in re.findall(r"\d{1,4}", text)]
    if max(counts, default=1) > _MOST_YARNS or 0 in counts:
        raise InputError(f"'{text.strip()}': numbers of yarns must be from 1 to {_MOST_YARNS}", where="weave")
    match = re.fullmatch(r"\s*(plain|basket|twill|satin)\s*(\d{1,4})?\s*(?:/\s*(\d{1,4}))?\s*", text)
    if match is not None:
        name, given = match[1], len(counts)
        if (name, given) == ("plain", 0):
            return plain()
        if (name, given) == ("basket", 1):
            return basket(counts[0])
        if (name, given) == ("twill", 2):
            return twill(*counts)
        if (name, given) == ("satin", 2):
            return satin(*counts)
    elif words and set("".join(words)) <= {"X", "x", "."} and len({len(word) for word in words}) == 1:
        return np.array([[c in "Xx" for c in word] for word in words])
    raise InputError(
        f"'{text.strip()[:40]}' is not a weave",
        where="weave",
        hint="plain, basket 2, twill 3/1, satin 5/2, or equal rows of X (warp above) and . (weft above)",
    )


def woven_lines(draft: Draft, aspect: float, apart: float) -> tuple[list[Curve], list[Curve]]:
    """Center lines of warps and wefts of one tile of a draft (rows, columns), `apart` at crossings."""
    rows, columns = draft.shape
    # Row 0 is the side v → 1.
    above = draft[::-1]
    warps = []
    for column in range(columns):
        crossings = np.empty((rows, 3))
        crossings[:, 0] = (column + 0.5) / columns
        crossings[:, 1] = aspect * (np.arange(rows) + 0.5) / rows
        crossings[:, 2] = np.where(above[:, column], 0.5 * apart, -0.5 * apart)
        warps.append(_undulating(crossings, np.array([0.0, aspect, 0.0])))
    wefts = []
    for row in range(rows):
        crossings = np.empty((columns, 3))
        crossings[:, 0] = (np.arange(columns) + 0.5) / columns
        crossings[:, 1] = aspect * (row + 0.5) / rows
        crossings[:, 2] = np.where(above[row], -0.5 * apart, 0.5 * apart)
        wefts.append(_undulating(crossings, np.array([1.0, 0.0, 0.0])))
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
    refuse_special(path)
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

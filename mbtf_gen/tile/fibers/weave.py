"""Woven and knitted cloth: drafts, and the center lines of their yarns.

A draft is a rectangle of crossings, row by row from the side ``v → 1``: ``X`` where the warp, which runs
along v, lies above, ``.`` where the weft does. Both sets of yarns undulate about the plane between them. At a
crossing the upper yarn lies on the lower one. Between crossings a yarn rises and falls like a cosine.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_gen.tile.fibers.curves import F64, Curve

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

"""Drafts of weaves, sequences of yarns, and the period that both have together.

A draft is a rectangle of crossings, row by row from the side ``v → 1``: ``X`` where the warp, which runs
along v, lies above, ``.`` where the weft does. A sequence names the yarns of the warps from u = 0, or of the
wefts from v → 1, in the notation of thread counts: ``red4 white2``. Draft and sequences together make the
color-and-weave effect: what is seen at a crossing is the color of the yarn above.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.paths import suggest_name

Draft = NDArray[np.bool_]

# Most yarns of a draft or of a sequence along one side.
_MOST_YARNS = 1024
# Crossings of one tile, each of some hundred fiber segments.
_MOST_CROSSINGS = 1 << 16


def plain() -> Draft:
    """Draft of the plain weave."""
    return basket(1)


def basket(n: int) -> Draft:
    """Draft of the basket weave of n × n yarns: a plain weave whose yarns are n side by side."""
    row, column = np.indices((2 * n, 2 * n)) // n
    return np.asarray((row + column) % 2 == 0)


def twill(*floats: int) -> Draft:
    """Draft of a right-hand (Z) twill: warps lie above `floats[0]` wefts, below `floats[1]`, and so on, one
    crossing further per yarn.

    Raises
    ------
    InputError : an odd number of floats
    """
    if len(floats) % 2:
        raise InputError("a twill needs pairs of numbers over/under", where="weave", hint="such as twill 2/1")
    cycle = np.repeat(np.arange(len(floats)) % 2 == 0, floats)
    row, column = np.indices((len(cycle), len(cycle)))
    return cycle[(row + column) % len(cycle)]


def herringbone(over: int = 2, under: int = 2, width: int = 8) -> Draft:
    """Draft of a broken twill: its diagonal reverses every `width` warps. Where it does, the diagonals are
    offset: of balanced twills, warps lie above where their neighbors lie below."""
    n = over + under
    row, column = np.indices((n, 2 * width))
    mirrored = row - column + 2 * width - 1 + over
    return np.asarray(np.where(column < width, row + column, mirrored) % n < over)


def satin(n: int, step: int) -> Draft:
    """Draft of a satin of n yarns: each warp lies below one weft in n, `step` crossings further per yarn.

    Raises
    ------
    InputError : the wefts' crossings would not be spread over the draft
    """
    if n < 5 or not 1 < step < n - 1 or np.gcd(n, step) != 1:
        raise InputError(
            f"a satin of {n} yarns has no step of {step}",
            where="weave",
            hint="take 5 yarns or more, and a step from 2 to n - 2 that shares no factor with n",
        )
    row, column = np.indices((n, n))
    return np.asarray((row - step * column) % n != 0)


# Weaves by name: (fewest, most) numbers that follow the name, and the draft.
_WEAVES: dict[str, tuple[tuple[int, int], Callable[..., Draft]]] = {
    "plain": ((0, 0), plain),
    "basket": ((1, 1), basket),
    "twill": ((2, 8), twill),
    "satin": ((2, 2), satin),
    "herringbone": ((0, 3), herringbone),
    "houndstooth": ((0, 0), lambda: twill(2, 2)),
    "gingham": ((0, 1), lambda n=8: plain()),
    "denim": ((0, 0), lambda: twill(3, 1)),
}
_EXAMPLES = (
    "plain, basket 2, twill 3/1, satin 5/2, herringbone 2/2 8, houndstooth, gingham 8, denim, or equal rows "
    "of X (warp above) and . (weft above)"
)

# Cloth that is not woven here.
_PILE = "pile comes from a file of its fibers: curves: FILE"
_KNIT = "a stockinette is 'knit: {stitches: 4, rows: 4}', other knits are .pyp files: pattern: FILE"
_OTHERS = dict.fromkeys(("velvet", "corduroy", "terry", "pile", "plush", "fur"), _PILE) | dict.fromkeys(
    ("knit", "jersey", "stockinette", "rib", "ribbing", "garter"), _KNIT
)


def parse_draft(text: str) -> Draft:
    """Draft of a name with its numbers, or of rows of ``X`` and ``.``.

    Raises
    ------
    InputError : neither of the two
    """
    name, counts = _named(text)
    if name is not None:
        return _WEAVES[name][1](*counts)
    words = text.split()
    if words and set("".join(words)) <= {"X", "x", "."} and len({len(word) for word in words}) == 1:
        return np.array([[c in "Xx" for c in word] for word in words])
    what = f"'{text.strip()[:40]}' is not a weave"
    word = (words or [""])[0].lower()
    hint = _OTHERS.get(word) or ("" if word in _WEAVES else suggest_name(word, list(_WEAVES)))
    raise InputError(what, where="weave", hint=hint or _EXAMPLES)


def _named(text: str) -> tuple[str | None, list[int]]:
    """Name and numbers of a named weave; None for other texts."""
    match = re.fullmatch(r"\s*([a-z]+)((?:\s*/\s*|\s*)\d{1,6}(?:(?:\s*/\s*|\s+)\d{1,6})*)?\s*", text)
    if match is None or match[1] not in _WEAVES:
        return None, []
    counts = [int(word) for word in re.findall(r"\d+", match[2] or "")]
    (fewest, most), _ = _WEAVES[match[1]]
    if not fewest <= len(counts) <= most:
        return None, []
    if sum(counts) > _MOST_YARNS or 0 in counts:
        what = f"'{text.strip()}': numbers of yarns must be from 1 to {_MOST_YARNS}"
        raise InputError(what, where="weave")
    return match[1], counts


def colors_of(text: str) -> tuple[int, int] | None:
    """Numbers of adjacent warps, and of adjacent wefts, of one color in weaves that are named for their
    colors; None for others. Denim has warps of one color and wefts of another, (0, 0)."""
    name, counts = _named(text)
    if name == "gingham":
        n = counts[0] if counts else 8
        return n, n
    return {"houndstooth": (4, 4), "denim": (0, 0)}.get(name or "")


def parse_sequence(text: str, where: str) -> list[str]:
    """Names of yarns of a thread count.

    ``red4 white2`` is four red yarns and two white ones. As for tartans, slashes after the first and the last
    name mark pivots, at which the sequence reverses: ``red/4 white2 blue/6`` is ``red4 white2 blue6 white2``.

    Raises
    ------
    InputError : another text, or too many yarns
    """
    words = [re.fullmatch(r"([A-Za-z_]+)(/?)(\d{0,6})", word) for word in re.split(r"[\s,]+", text.strip())]
    found = [(match[1], match[2], int(match[3] or 1)) for match in words if match is not None]
    pivots = [slash for _, slash, _ in found]
    mirrored = len(found) > 1 and [bool(slash) for slash in pivots] == [
        k in (0, len(found) - 1) for k in range(len(found))
    ]
    if len(found) != len(words) or any(count == 0 for *_, count in found) or (any(pivots) and not mirrored):
        raise InputError(
            f"'{text.strip()[:40]}' is not a sequence of yarns",
            where=where,
            hint="names with numbers, such as red4 white2; reversed at both ends: red/4 white2 blue/6",
        )
    if mirrored:
        found += found[-2:0:-1]
    if sum(count for *_, count in found) > _MOST_YARNS:
        raise InputError(f"has more than {_MOST_YARNS} yarns", where=where)
    return [name for name, _, count in found for _ in range(count)]


@dataclass(frozen=True, eq=False)
class Weave:
    """One tile of woven cloth.

    Attributes
    ----------
    draft : (wefts, warps), whether the warp lies above, row by row from v → 1
    warp, weft : names of the yarns, from u = 0, and from v → 1
    """

    draft: Draft
    warp: tuple[str, ...]
    weft: tuple[str, ...]

    @classmethod
    def of(cls, draft: Draft, warp: list[str], weft: list[str], repeat: int = 1) -> Weave:
        """The period of a draft and two sequences, `repeat` times along each side.

        Raises
        ------
        InputError : it has too many crossings
        """
        rows, columns = math.lcm(len(draft), len(weft)), math.lcm(draft.shape[1], len(warp))
        if rows * columns * repeat**2 > _MOST_CROSSINGS:
            raise InputError(
                f"repeats after {columns} warps and {rows} wefts, {repeat} x {repeat} times in a tile: more "
                f"than {_MOST_CROSSINGS:,} crossings",
                where="weave",
                hint=f"take fewer repeats, or sequences of lengths that share factors with each other and "
                f"with the {draft.shape[1]} x {len(draft)} yarns of the draft",
            )
        rows, columns = rows * repeat, columns * repeat
        tiled = np.tile(draft, (rows // len(draft), columns // draft.shape[1]))
        return cls(tiled, tuple(warp * (columns // len(warp))), tuple(weft * (rows // len(weft))))

    def seen(self) -> NDArray[np.str_]:
        """Name (wefts, warps) of the yarn above at each crossing: the color-and-weave effect."""
        return np.where(self.draft, np.array(self.warp)[None, :], np.array(self.weft)[:, None])

    def properties(self) -> dict[str, Any]:
        """Draft, sequences, and color-and-weave effect as plain data."""
        return {
            "draft": ["".join("X" if up else "." for up in row) for row in self.draft],
            "warp": " ".join(self.warp),
            "weft": " ".join(self.weft),
            "seen": [" ".join(row) for row in self.seen()],
        }

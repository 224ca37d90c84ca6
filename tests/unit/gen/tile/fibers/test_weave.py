"""Drafts of textbooks, sequences of yarns, and the center lines of woven and knitted yarns."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from mbtf_core.errors import InputError
from mbtf_gen.tile.fibers.curves import Curve
from mbtf_gen.tile.fibers.draft import Weave, colors_of, parse_draft, parse_sequence
from mbtf_gen.tile.fibers.weave import knitted_lines, woven_lines


def height_at(line: Curve, axis: int, position: float) -> float:
    at = line.at(np.linspace(0.0, len(line.control), 4001))[0]
    return float(at[np.argmin(np.abs(at[:, axis] - position)), 2])


def test_the_yarn_of_the_draft_lies_above_at_each_crossing() -> None:
    draft = parse_draft("X..X\nXX..\n.XX.\n..XX\nX.X.")
    apart = 0.1 + 0.01 * np.arange(20).reshape(5, 4)
    warps, wefts = woven_lines(draft, 1.25, apart)
    for row in range(5):
        # Row 0 is the side v → 1.
        y = 1.25 * (1.0 - (row + 0.5) / 5)
        for column in range(4):
            x = (column + 0.5) / 4
            warp, weft = height_at(warps[column], 1, y), height_at(wefts[row], 0, x)
            expected = apart[row, column] if draft[row, column] else -apart[row, column]
            assert warp - weft == pytest.approx(expected, abs=2e-4)


def distances(a: Curve, b: Curve, period: tuple[float, float]) -> float:
    """Least distance of two center lines and their copies."""
    p, q = (c.at(np.linspace(0.0, len(c.control), 600, endpoint=False))[0][:, :3] for c in (a, b))
    gap = p[:, None] - q[None]
    gap[..., 0] -= np.round(gap[..., 0] / period[0]) * period[0]
    gap[..., 1] -= np.round(gap[..., 1] / period[1]) * period[1]
    return float(np.linalg.norm(gap, axis=-1).min())


def test_loops_of_a_knit_interlock_without_touching() -> None:
    lines = knitted_lines(3, 3, 0.8)
    assert all(distances(a, b, (1.0, 0.8)) > 0.06 for a in lines for b in lines if a is not b)
    # The head of each loop lies behind its own legs' neighbors and before the row above: where two rows
    # overlap, each is above the other as often as below.
    a, b = (
        line.at(np.linspace(0.0, len(line.control), 3000, endpoint=False))[0][:, :3] for line in lines[:2]
    )
    above = []
    for point in a:
        gap = b[:, :2] - point[:2]
        gap[:, 0] -= np.round(gap[:, 0])
        near = np.argmin(np.hypot(*gap.T))
        if np.hypot(*gap[near]) < 0.004:
            above.append(point[2] > b[near, 2])
    assert 0.2 < np.mean(above) < 0.8


# Houndstooth: four dark and four light yarns both ways in a 2/2 twill (# dark).
HOUNDSTOOTH = ["####..##", "####.##.", "######..", "#####..#", "##......", "#..#....", "..##....", ".##....."]
# Herringbone 2/2 of four warps: the ends of both halves are opposite where the diagonal reverses.
HERRINGBONE = ["XX..XX..", "X..X.XX.", "..XX..XX", ".XX.X..X"]


def rows(text: str) -> list[str]:
    return ["".join("X" if c else "." for c in row) for row in parse_draft(text)]


def named(text: str, warp: str, weft: str, repeat: int = 1) -> Weave:
    return Weave.of(parse_draft(text), parse_sequence(warp, "warp"), parse_sequence(weft, "weft"), repeat)


def test_named_drafts_are_those_of_textbooks() -> None:
    assert rows("plain") == ["X.", ".X"]
    assert rows("basket 2") == ["XX..", "XX..", "..XX", "..XX"]
    # 3/1 twill: each warp above three wefts, the steps on a diagonal.
    assert rows("twill 3/1") == rows("denim") == ["XXX.", "XX.X", "X.XX", ".XXX"]
    assert rows("twill 2/1") == ["XX.", "X.X", ".XX"]
    assert rows("twill 2/1/1/2")[0] == "XX.X.."
    assert rows("herringbone 2/2 4") == HERRINGBONE
    assert rows("herringbone") == rows("herringbone 2/2 8")
    assert rows("gingham 3") == rows("plain")
    assert rows("X.X\n.X.") == ["X.X", ".X."]


@pytest.mark.parametrize(("n", "step"), [(5, 2), (7, 3), (8, 3)])
def test_a_satin_has_scattered_crossings_and_floats_of_all_others(n: int, step: int) -> None:
    weave = named(f"satin {n}/{step}", "a", "b")
    below = [int(np.flatnonzero(~row)[0]) for row in weave.draft]
    assert sorted(below) == list(range(n))
    assert all(abs(a - b) not in (1, n - 1) for a, b in pairwise([*below, below[0]]))


def test_houndstooth_is_the_known_effect_of_eight_by_eight_yarns() -> None:
    assert colors_of("houndstooth") == (4, 4)
    seen = named("houndstooth", "dark4 light4", "dark4 light4").seen()
    assert ["".join("#" if name == "dark" else "." for name in row) for row in seen] == HOUNDSTOOTH


def test_the_period_is_the_least_common_multiple() -> None:
    weave = named("twill 2/1", "a2 b2", "c5", repeat=2)
    assert weave.draft.shape == (30, 24)
    assert (weave.draft == weave.draft[:3, :3][np.ix_(np.arange(30) % 3, np.arange(24) % 3)]).all()
    assert weave.warp[:5] == ("a", "a", "b", "b", "a")
    with pytest.raises(InputError, match="after 1021 warps and 1019 wefts"):
        named("X", "a1021", "a1019")


def test_sequences_are_thread_counts() -> None:
    assert parse_sequence("red2 white", "warp") == ["red", "red", "white"]
    assert parse_sequence("K/2, R1 Y/3", "warp") == list("KKRYYYR")

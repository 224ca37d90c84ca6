"""Drafts, sequences of yarns, and the color-and-weave effects of textbooks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from mbtf_core.errors import InputError
from mbtf_gen.tile.fibers.draft import Weave, colors_of, parse_draft, parse_sequence

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


@pytest.mark.parametrize("width", [4, 5, 8])
def test_herringbone_reverses_every_so_many_warps_and_breaks_there(width: int) -> None:
    draft = parse_draft(f"herringbone 2/2 {width}")
    assert draft.shape == (4, 2 * width)
    columns = draft.T.tolist()
    for k, (a, b) in enumerate(pairwise([*columns, columns[0]])):
        if k in (width - 1, 2 * width - 1):
            assert a == [not up for up in b]
        else:
            # One pick further: up to the right, then down to the right.
            assert np.roll(a, -1 if k < width else 1).tolist() == b


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

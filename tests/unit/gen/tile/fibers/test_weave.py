"""The center lines of woven and knitted yarns."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_gen.tile.fibers.curves import Curve
from mbtf_gen.tile.fibers.draft import parse_draft
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

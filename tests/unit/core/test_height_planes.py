"""The table that rays look a height field up in: exact cells, planes that nothing pierces."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_core import height_planes
from mbtf_core.height_planes import node_table

SHAPES = [(1, 1), (1, 7), (2, 2), (5, 3), (8, 8), (13, 32), (33, 9)]


@pytest.mark.parametrize("below", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_no_vertex_pierces_a_plane(
    shape: tuple[int, int], below: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(height_planes, "_PASS_NUMBERS", 100)
    rng = np.random.default_rng(shape[0])
    z = np.where(rng.random(shape) < 0.2, -3.0, 0.0) + rng.random(shape)
    table = node_table(z, below)
    rows, columns = shape
    columns_log2, rows_log2 = ((n - 1).bit_length() for n in (columns, rows))
    finest = min(columns_log2, rows_log2)
    touched = 0
    for level in range(1, finest + 1):
        side = 1 << level
        for j in range(-(-rows // side)):
            for i in range(-(-columns // side)):
                first = z.size + (1 << (columns_log2 + rows_log2 - 2 * level))
                plane = table[first + (j << (columns_log2 - level)) + i]
                x = np.arange(min(side, columns - i * side) + 1)
                y = np.arange(min(side, rows - j * side) + 1)[:, None]
                h = z[(y + j * side) % rows, (x + i * side) % columns]
                gap = plane[0] + plane[1] * x + plane[2] * y - h
                gap = -gap if below else gap
                assert gap.min() > 0
                touched += gap.min() < 1e-5
                assert plane[3] == 0
    # As low as they can be.
    assert touched == sum(-(-rows // s) * -(-columns // s) for s in 2 ** np.arange(1, finest + 1))

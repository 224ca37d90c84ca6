"""The table that rays look a height field up in: exact cells, planes that nothing pierces."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mbtf_core import height_planes
from mbtf_core.height_planes import node_table
from mbtf_gen.tile.heights import HeightGrid, grid_faces, grid_vertices

SHAPES = [(1, 1), (1, 7), (2, 2), (5, 3), (8, 8), (13, 32), (33, 9)]


def heights(shape: tuple[int, int]) -> NDArray[np.float64]:
    rng = np.random.default_rng(shape[0])
    return np.where(rng.random(shape) < 0.2, -3.0, 0.0) + rng.random(shape)


def value(row: NDArray[np.float32], x: float, y: float) -> float:
    c, a, b, w = (float(v) for v in row)
    return c + a * x + b * y + w * max(0.0, x + y - 1.0)


@pytest.mark.parametrize("shape", SHAPES)
def test_cells_are_the_meshs_triangles(shape: tuple[int, int]) -> None:
    z = heights(shape)
    rows, columns = shape
    cells = node_table(z)[: z.size].reshape(rows, columns, 4)
    # The mesh counts rows from the side v → 1, the table along +y.
    vertices = grid_vertices(HeightGrid(z[::-1], 1.0))
    triangles = vertices.reshape(-1, 3)[grid_faces(rows + 1, columns + 1)].reshape(rows, columns, 2, 3, 3)
    for j in range(rows):
        for i in range(columns):
            for corners in triangles[rows - 1 - j, i]:
                for px, py, pz in [*corners, corners.mean(axis=0)]:
                    # The mesh's first row of cells lies below the first row of vertices.
                    x, y = px * columns - 0.5 - i, py * rows + 0.5 - j
                    assert value(cells[(j - 1) % rows, i], x, y) == pytest.approx(pz, abs=1e-6)


@pytest.mark.parametrize("below", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_no_vertex_pierces_a_plane(
    shape: tuple[int, int], below: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(height_planes, "_PASS_NUMBERS", 100)
    z = heights(shape)
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

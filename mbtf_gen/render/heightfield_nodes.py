"""The table in which rays look up a height field: every cell's exact surface, and planes above its blocks.

A row holds four numbers (c, a, b, w): over a place (x, y), counted in cells from the corner of a cell or
block, stands the surface ``c + a·x + b·y + w·max(0, x+y-1)``. For a cell that is exactly its two triangles,
which meet along ``x + y = 1``. For a block of 2^L × 2^L cells w is zero, and the plane lies nowhere below the
surface: tighter than the block's highest point wherever the surface has a slope.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Numbers that one pass over a level's blocks may hold at once.
_PASS_NUMBERS = 1 << 23
# How far above the surface planes are lifted, as a share of the relief: the rounding of single precision.
_LIFT = 4e-7


@dataclass(frozen=True)
class NodeTable:
    """Rows of the table and where they stand.

    Attributes
    ----------
    rows : (n, 4) float32; first the cells in row order, then the blocks
    columns_log2, rows_log2 : logarithms of the cells along x and y, rounded up
    finest : levels of blocks are 1 … finest

    Block (i, j) of level L is row ``cells + 2^(columns_log2 + rows_log2 - 2L) + j·2^(columns_log2 - L) + i``:
    levels take disjoint ranges, for each has a quarter of the blocks of the one before.
    """

    rows: NDArray[np.float32]
    columns_log2: int
    rows_log2: int
    finest: int


def node_table(z: NDArray[np.float64], below: bool = False) -> NodeTable:
    """Table of a periodic grid of heights.

    Parameters
    ----------
    z : (rows, columns) heights, row index along +y
    below : planes lie nowhere above the surface, instead
    """
    height, width = z.shape
    columns_log2, rows_log2 = ((n - 1).bit_length() for n in (width, height))
    finest = min(columns_log2, rows_log2)
    cells = z.size
    blocks = 1 << (columns_log2 + rows_log2 - 1) if finest else 0
    rows = np.zeros((cells + blocks, 4), np.float32)
    right, up = np.roll(z, -1, 1), np.roll(z, -1, 0)
    twist = np.roll(right, -1, 0) - right - up + z
    rows[:cells] = np.stack([z, right - z, up - z, twist], -1).reshape(-1, 4)
    sign = -1.0 if below else 1.0
    lift = _LIFT * float(np.ptp(z))
    for level in range(1, finest + 1):
        first = cells + (1 << (columns_log2 + rows_log2 - 2 * level))
        stride = 1 << (columns_log2 - level)
        for j, planes in _planes(sign * z, level):
            planes[..., 0] += lift
            start = first + j * stride
            block = rows[start : start + len(planes) * stride].reshape(len(planes), stride, 4)
            block[:, : planes.shape[1], :3] = sign * planes
    return NodeTable(rows, columns_log2, rows_log2, finest)


def _planes(z: NDArray[np.float64], level: int) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """(number of the first row, planes (rows, columns, 3) above the blocks of a level), part by part."""
    height, width = z.shape
    side = 1 << level
    x, wide = _vertices(width, side)
    down = -(-height // side)
    part = max(1, _PASS_NUMBERS // ((side + 1) * x.size))
    for j in range(0, down, part):
        y, tall = _vertices(height, side, j, min(j + part, down))
        columns = (x + np.arange(len(x))[:, None] * side) % width
        lines = (y + np.arange(j, j + len(y))[:, None] * side) % height
        h = z[lines[:, None, :, None], columns[None, :, None, :]]
        a = (h[..., -1].mean(-1) - h[..., 0].mean(-1)) / wide
        b = (h[..., -1, :].mean(-1) - h[..., 0, :].mean(-1)) / tall[:, None]
        level_top = h.max((2, 3))
        h -= a[..., None, None] * x[None, :, None, :]
        h -= b[..., None, None] * y[:, None, :, None]
        sloped = h.max((2, 3))
        # Whichever stands lower over the block's middle.
        better = sloped + 0.5 * (a * wide + b * tall[:, None]) < level_top
        yield j, np.where(better[..., None], np.stack([sloped, a, b], -1), _level_planes(level_top))


def _vertices(
    cells: int, side: int, start: int = 0, stop: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Places of blocks' vertices along one axis, counted from the block's corner (blocks, side + 1), and the
    blocks' lengths; the last block ends with the period, where its last vertex is repeated."""
    blocks = np.arange(start, -(-cells // side) if stop is None else stop)
    length = np.minimum(side, cells - blocks * side)
    return np.minimum(np.arange(side + 1), length[:, None]), length


def _level_planes(height: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([height, np.zeros_like(height), np.zeros_like(height)], -1)

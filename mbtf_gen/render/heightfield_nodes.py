"""Acceleration structure of a height field: the exact surface of each cell, and bounding planes of blocks.

A row has four numbers (c, a, b, w). At (x, y), in cells from the corner of a cell or block, its height is
``c + a·x + b·y + w·max(0, x+y-1)``. For a cell this is the surface: two triangles that meet at
``x + y = 1``. For a block of 2^L × 2^L cells w is zero, and the plane is nowhere below the surface. On slopes
it is a tighter bound than the block's maximum.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Numbers held in memory at once while the blocks of a level are computed.
_PASS_NUMBERS = 1 << 23
# Margin of the planes, relative to the displacement range: the rounding of single precision.
_MARGIN = 4e-7


@dataclass(frozen=True)
class NodeTable:
    """Rows of the table and their layout.

    Block (i, j) of level L is row ``cells + 2^(columns_log2 + rows_log2 - 2L) + j·2^(columns_log2 - L) + i``.
    The ranges of the levels are disjoint, because each has a quarter of the blocks of the one below.

    Attributes
    ----------
    rows : (n, 4) float32; first the cells in row order, then the blocks
    columns_log2, rows_log2 : logarithms of the cells along x and y, rounded up
    finest : blocks have the levels 1 … finest
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
    below : the planes bound the surface from below instead
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
    margin = _MARGIN * float(np.ptp(z))
    for level in range(1, finest + 1):
        first = cells + (1 << (columns_log2 + rows_log2 - 2 * level))
        stride = 1 << (columns_log2 - level)
        for j, planes in _planes(sign * z, level):
            planes[..., 0] += margin
            start = first + j * stride
            block = rows[start : start + len(planes) * stride].reshape(len(planes), stride, 4)
            block[:, : planes.shape[1], :3] = sign * planes
    return NodeTable(rows, columns_log2, rows_log2, finest)


def _planes(z: NDArray[np.float64], level: int) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """(first row, planes (rows, columns, 3) of the blocks) of a level, part by part."""
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
        # The plane that is lower at the block's center.
        better = sloped + 0.5 * (a * wide + b * tall[:, None]) < level_top
        yield j, np.where(better[..., None], np.stack([sloped, a, b], -1), _level_planes(level_top))


def _vertices(
    cells: int, side: int, start: int = 0, stop: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Positions (blocks, side + 1) of the blocks' vertices along one axis from the block's corner, and the
    blocks' lengths. The last block ends with the period; its last vertex is repeated."""
    blocks = np.arange(start, -(-cells // side) if stop is None else stop)
    length = np.minimum(side, cells - blocks * side)
    return np.minimum(np.arange(side + 1), length[:, None]), length


def _level_planes(height: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([height, np.zeros_like(height), np.zeros_like(height)], -1)

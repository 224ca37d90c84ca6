"""Table of a periodic height field that rays traverse: exact cells, and planes that bound blocks of cells.

The nodes form a table whose rows have four numbers (c, a, b, w). At (x, y), in cells from the corner of a
cell or block, its height is ``c + a·x + b·y + w·max(0, x+y-1)``. For a cell this is the surface: two
triangles that meet at ``x + y = 1``. For a block of 2^L × 2^L cells w is zero, and the plane is nowhere below
the surface. On slopes it is a tighter bound than the block's maximum.

The cells come first, in row order. Block (i, j) of level L from 1 to ``finest`` is row
``cells + 2^(columns_log2 + rows_log2 - 2L) + j·2^(columns_log2 - L) + i``. The ranges of the levels are
disjoint, because each has a quarter of the blocks of the one below.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

# Numbers held in memory at once while the blocks of a level are computed.
_PASS_NUMBERS = 1 << 23
# Margin of the planes, relative to the displacement range: the rounding of single precision.
_MARGIN = 4e-7


def logarithms(z: NDArray[np.float64]) -> tuple[int, int]:
    """Logarithms to base 2 of the numbers of columns and rows, rounded up."""
    return (z.shape[1] - 1).bit_length(), (z.shape[0] - 1).bit_length()


def node_table(z: NDArray[np.float64], below: bool = False) -> NDArray[np.float32]:
    """Nodes (n, 4) of a periodic grid of heights (rows, columns), row index along +y. The planes bound the
    surface from above, or from `below`."""
    columns_log2, rows_log2 = logarithms(z)
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
    return rows


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
        level_plane = np.stack([level_top, np.zeros_like(a), np.zeros_like(a)], -1)
        yield j, np.where(better[..., None], np.stack([sloped, a, b], -1), level_plane)


def _vertices(
    cells: int, side: int, start: int = 0, stop: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Positions (blocks, side + 1) of the blocks' vertices along one axis from the block's corner, and the
    blocks' lengths. The last block ends with the period; its last vertex is repeated."""
    blocks = np.arange(start, -(-cells // side) if stop is None else stop)
    length = np.minimum(side, cells - blocks * side)
    return np.minimum(np.arange(side + 1), length[:, None]), length

"""Bilinear lookups in a packed pyramid of periodic textures, blended between two levels.

All levels lie one after the other in a single table (texels, channels); level s has ``rows[s] × columns[s]``
texels from row ``start[s]`` on, image row by image row: row 0 is the side ``v → 1``, texel centers at
``((i+½)/W, 1-(j+½)/H)``, wrapped in both directions.

:func:`lookup` gathers by ``embedding_bag``, with analytic derivatives. One sparse product gives the gradients
of the texels.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from mbtf_core.data.lattice import Lattice


@dataclass(frozen=True)
class Packing:
    """Layout of a pyramid's levels in their table: (rows, columns) of each, coarsest first."""

    shapes: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, lattice: Lattice, levels: Sequence[int]) -> Packing:
        """Packing of the given levels of a lattice."""
        return cls(tuple(lattice.shape(s) for s in levels))

    @property
    def starts(self) -> list[int]:
        """First row of each level in the table, and the number of texels."""
        return [0, *np.cumsum([rows * columns for rows, columns in self.shapes]).tolist()]

    @property
    def texels(self) -> int:
        """Rows of the table."""
        return self.starts[-1]

    def split(self, table: Tensor) -> list[Tensor]:
        """Levels (rows, columns, channels) of a table, which share its memory."""
        parts = table.split([rows * columns for rows, columns in self.shapes])
        return [part.view(*shape, -1) for part, shape in zip(parts, self.shapes, strict=True)]

    @staticmethod
    def join(levels: Iterable[Tensor]) -> Tensor:
        """Inverse of :meth:`split`."""
        return torch.cat([level.flatten(0, 1) for level in levels])


def coarse_level(level: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """(coarser level, weight of the next finer one) of fractional levels, clamped to ``[0, count-1]``.

    The weights are ``1 - frac(l)`` and ``frac(l)``. The paper prints ``⌈l⌉-l`` and ``l-⌊l⌋``, which are both
    zero at whole levels.
    """
    clamped = level.clamp(0, count - 1)
    coarse = clamped.floor().clamp_max_(max(count - 2, 0))
    return coarse, clamped - coarse


@dataclass(frozen=True)
class Corners:
    """The texels that queries read. Arrays (parts, n): one part per level that is blended.

    Attributes
    ----------
    index : (n, 4·parts) int32 rows of the table; per part: top left, top right, bottom left, bottom right
    fx, fy : position between the texels, in [0, 1)
    scale : weight of the part, (parts, n), or None for 1
    columns, rows : size of the part's level, (parts, n) or numbers
    """

    index: Tensor
    fx: Tensor
    fy: Tensor
    scale: Tensor | None
    columns: Any
    rows: Any

    def weights(self) -> Tensor:
        """(n, 4·parts) weight of each corner."""
        right = self.fx if self.scale is None else self.fx * self.scale
        left = 1 - right if self.scale is None else self.scale - right
        lower_right, lower_left = right * self.fy, left * self.fy
        return _interleave(left - lower_left, right - lower_right, lower_left, lower_right)

    def slopes(self) -> tuple[Tensor, Tensor]:
        """Derivatives of :meth:`weights` by u and by v, (n, 4·parts) each."""
        # v grows upwards, image rows grow downwards.
        across = self.columns if self.scale is None else self.columns * self.scale
        down = self.rows if self.scale is None else self.rows * self.scale
        low, low_right = across * self.fy, down * self.fx
        high, high_left = across - low, down - low_right
        by_u = _interleave(-high, high, -low, low)
        by_v = _interleave(high_left, low_right, -high_left, -low_right)
        return by_u, by_v


def _interleave(*corners: Tensor) -> Tensor:
    """Four arrays (parts, n) → (n, 4·parts)."""
    parts = zip(*(corner.unbind(0) for corner in corners), strict=True)
    return torch.stack([row for part in parts for row in part], 1)


def _wrap(index: Tensor, size: Any) -> Tensor:
    """Whole numbers stored as floats, modulo size."""
    return index - size * torch.floor(index / size)


def find_corners(packing: Packing, u: Tensor, level: Tensor | None) -> Corners:
    """Texels that queries at `u` (n, 2) and `level` (n,) read."""
    columns: Any
    rows: Any
    start: Any
    scale: Tensor | None
    if level is None:
        rows, columns = packing.shapes[0]
        start, scale = 0, None
    else:
        coarse, fine_weight = coarse_level(level, len(packing.shapes))
        scale = torch.stack([1 - fine_weight, fine_weight])
        which = coarse.to(torch.int64)
        which = torch.stack([which, (which + 1).clamp_max_(len(packing.shapes) - 1)])
        sizes = torch.tensor(packing.shapes, dtype=u.dtype, device=u.device)
        rows, columns = sizes[:, 0][which], sizes[:, 1][which]
        start = torch.tensor(packing.starts[:-1], dtype=torch.int32, device=u.device)[which]
    x = (u[:, 0] * columns - 0.5).reshape(-1, len(u))
    y = ((1 - u[:, 1]) * rows - 0.5).reshape(-1, len(u))
    i, j = x.floor(), y.floor()
    fx, fy = x - i, y - j
    width = columns.to(torch.int32) if isinstance(columns, Tensor) else columns
    left, right = (_wrap(k, columns).to(torch.int32) for k in (i, i + 1))
    top, bottom = (_wrap(k, rows).to(torch.int32).mul_(width).add_(start) for k in (j, j + 1))
    index = _interleave(top + left, top + right, bottom + left, bottom + right)
    return Corners(index, fx, fy, scale, columns, rows)


def _weighted(table: Tensor, index: Tensor, weights: Tensor) -> Tensor:
    """Σ weights·table[index] per query: (n, channels)."""
    return embedding_bag(index, table, per_sample_weights=weights, mode="sum")


def add_up(index: Tensor, weights: Tensor, values: Tensor, rows: int) -> Tensor:
    """Transpose of a weighted gather: ``out[index[q, c]] += weights[q, c]·values[q]``, (rows, channels), for
    index and weights (n, corners) and values (n, channels).

    On a CPU one sparse product, whose order of summation is fixed: an order of magnitude faster than
    ``index_add_`` of rows this short, and the same bits at every run.
    """
    n, corners = index.shape
    if values.device.type != "cpu":
        out = values.new_zeros(rows, values.shape[1])
        return out.index_add_(0, index.reshape(-1), (weights[..., None] * values[:, None]).flatten(0, 1))
    from scipy.sparse import csr_array

    pointers = np.arange(0, n * corners + 1, corners, dtype=np.int32)
    matrix = csr_array((weights.reshape(-1).numpy(), index.reshape(-1).numpy(), pointers), shape=(n, rows))
    return torch.from_numpy(matrix.T @ values.numpy())


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, u: Tensor, packing: Packing, level: Tensor | None) -> Tensor:
        corners = find_corners(packing, u, level)
        weights = corners.weights()
        ctx.corners = corners
        ctx.save_for_backward(table, weights)
        return _weighted(table, corners.index, weights)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        table, weights = ctx.saved_tensors
        corners: Corners = ctx.corners
        g = gradients[0].contiguous()
        by_table = by_position = None
        if ctx.needs_input_grad[0]:
            by_table = add_up(corners.index, weights, g, len(table))
        if ctx.needs_input_grad[1]:
            slopes = corners.slopes()
            by_position = torch.stack([(_weighted(table, corners.index, s) * g).sum(1) for s in slopes], 1)
        return by_table, by_position, None, None


def lookup(table: Tensor, packing: Packing, u: Tensor, level: Tensor | None = None) -> Tensor:
    """Texture values (n, channels) at uv positions `u` (n, 2); differentiable once in `table` (texels,
    channels) and `u`.

    `level` (n,) is a fractional index into ``packing.shapes``; None reads level 0 alone.
    """
    out: Tensor = _Lookup.apply(table, u, packing, level)
    return out

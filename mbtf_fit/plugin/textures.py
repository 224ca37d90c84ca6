"""Bilinear lookups in a packed pyramid of periodic textures, in Dr.Jit kernels.

All levels lie one after the other in one buffer, texels of a level row by row (row 0 is the side ``v → 1``),
channels padded to whole groups of :data:`GROUP`, so that a texel is read by wide loads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .stored import F32

# Channels that one gather reads.
GROUP = 4


class Textures:
    """Textures of consecutive levels, coarsest first.

    Parameters
    ----------
    levels : (rows, columns, channels) each
    """

    def __init__(self, levels: Sequence[F32]) -> None:
        self.channels = levels[0].shape[2]
        self.groups = -(-self.channels // GROUP)
        padded = [
            np.pad(level, ((0, 0), (0, 0), (0, self.groups * GROUP - self.channels))).reshape(-1) for level in levels
        ]
        self.shapes = [level.shape[:2] for level in levels]
        starts = np.cumsum([0, *(rows * columns for rows, columns in self.shapes)])
        self.buffer = mi.Float(np.concatenate(padded))
        table = [[rows, columns, start, 0] for (rows, columns), start in zip(self.shapes, starts, strict=False)]
        self._table = mi.UInt32(np.array(table, np.uint32).reshape(-1))
        dr.eval(self.buffer, self._table)

    def __call__(self, u: Any, level: Any = None) -> list[Any]:
        """Features at uv positions, blended between two levels.

        Parameters
        ----------
        u : Point2f, any real numbers: the textures are periodic
        level : fractional number of the level, from 0 for the first; None reads the first level alone
        """
        x = mi.Point2f(u.x - dr.floor(u.x), 1.0 - (u.y - dr.floor(u.y)))
        if len(self.shapes) == 1 or level is None:
            rows, columns = self.shapes[0]
            return self._bilinear(x, mi.UInt32(rows), mi.UInt32(columns), mi.UInt32(0), None, [0.0] * self.channels)
        level = dr.clip(level, 0.0, len(self.shapes) - 1.0)
        coarse = dr.minimum(mi.UInt32(level), len(self.shapes) - 2)
        fine_weight = level - mi.Float(coarse)
        out: list[Any] = [0.0] * self.channels
        for index, scale in ((coarse, 1.0 - fine_weight), (coarse + 1, fine_weight)):
            rows, columns, start, _ = dr.gather(mi.Vector4u, self._table, index)
            out = self._bilinear(x, rows, columns, start, scale, out)
        return out

    def _bilinear(self, x: Any, rows: Any, columns: Any, start: Any, scale: Any, out: list[Any]) -> list[Any]:
        """`out` plus the texture of one level times a scale, at image positions x in [0, 1]."""
        px, py = dr.fma(x.x, mi.Float(columns), -0.5), dr.fma(x.y, mi.Float(rows), -0.5)
        left, top = dr.floor(px), dr.floor(py)
        fx, fy = px - left, py - top
        i, j = mi.Int32(left), mi.Int32(top)
        # x lies within the image: only the first texel's left and the last one's right neighbour wrap.
        i0 = mi.UInt32(dr.select(i < 0, mi.Int32(columns) - 1, i))
        i1 = mi.UInt32(dr.select(i + 1 >= mi.Int32(columns), 0, i + 1))
        j0 = start + columns * mi.UInt32(dr.select(j < 0, mi.Int32(rows) - 1, j))
        j1 = start + columns * mi.UInt32(dr.select(j + 1 >= mi.Int32(rows), 0, j + 1))
        right = fx if scale is None else fx * scale
        left_weight = 1.0 - fx if scale is None else scale - right
        low_right, low_left = right * fy, left_weight * fy
        for index, weight in (
            (j0 + i0, left_weight - low_left),
            (j0 + i1, right - low_right),
            (j1 + i0, low_left),
            (j1 + i1, low_right),
        ):
            texel = self._texel(index)
            out = [dr.fma(value, weight, total) for value, total in zip(texel, out, strict=True)]
        return out

    def _texel(self, index: Any) -> list[Any]:
        values: list[Any] = []
        for group in range(self.groups):
            place = index * self.groups + group
            values += list(dr.gather(mi.Vector4f, self.buffer, place))
        return values[: self.channels]

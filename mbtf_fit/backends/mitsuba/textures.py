"""Bilinear lookups in a packed pyramid of periodic textures, in Dr.Jit kernels.

All levels lie one after the other in one buffer, texels of a level row by row (row 0 is the side ``v → 1``),
channels padded to a multiple of :data:`GROUP`, so that wide loads read a texel.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mbtf_fit.backends.mitsuba.stored_material import F32
from mbtf_gen.engine.types import Float, Point2f, UInt32

# Channels that one gather reads.
GROUP = 4


def in_image(u: Point2f) -> Point2f:
    """Position in the image, from its left and its top, in [0, 1]."""
    return mi.Point2f(u.x - dr.floor(u.x), 1.0 - (u.y - dr.floor(u.y)))


class Textures:
    """Textures of consecutive levels, coarsest first.

    Parameters
    ----------
    levels : (rows, columns, channels) each
    by_group : whether all texels of a group of channels follow each other, for lookups of a single group
    """

    def __init__(self, levels: Sequence[F32], *, by_group: bool = False) -> None:
        self.channels = levels[0].shape[2]
        self.groups = -(-self.channels // GROUP)
        padded = np.concatenate([level.reshape(-1, self.channels) for level in levels])
        padded = np.pad(padded, ((0, 0), (0, self.groups * GROUP - self.channels)))
        # Distances of texels and of groups in the buffer.
        self._strides = (self.groups, 1)
        if by_group:
            self._strides = (1, len(padded))
            padded = padded.reshape(-1, self.groups, GROUP).transpose(1, 0, 2)
        self.shapes = [level.shape[:2] for level in levels]
        starts = np.cumsum([0, *(rows * columns for rows, columns in self.shapes)])
        # A copy: NumPy's memory is aligned to less than a cache line.
        self.buffer = mi.Float(padded.reshape(-1)) + dr.opaque(mi.Float, 0.0)
        table = [(*shape, start, 0) for shape, start in zip(self.shapes, starts, strict=False)]
        self.table = mi.UInt32(np.array(table, np.uint32).reshape(-1))
        dr.eval(self.buffer, self.table)

    def first(self, u: Point2f) -> list[Float]:
        """Features of the first level at uv positions (Point2f), any real numbers: textures are periodic."""
        rows, columns = self.shapes[0]
        layout = (mi.UInt32(rows), mi.UInt32(columns), mi.UInt32(0))
        return self._bilinear(in_image(u), *layout, None, [0.0] * self.channels)

    def blended(self, u: Point2f, level: Float, group: UInt32 | None = None) -> list[Float]:
        """Features between two levels: (1 - frac(level)) of the coarser, frac(level) of the finer one; of one
        group of four channels where its number is given."""
        channels = self.channels if group is None else GROUP
        coarse, weight = self._coarse(level)
        low = self._level(u, coarse, 1.0 - weight, [0.0] * channels, group)
        if len(self.shapes) == 1:
            return low
        # Packets of lanes at whole levels, as where the finest one is magnified, read one level. The
        # condition has the lanes of what it selects: one level may be that of many positions.
        return dr.if_stmt(
            (u, coarse, weight, low, group),
            (weight > 0.0) & (u.x == u.x),
            lambda u, coarse, weight, low, group: self._level(u, coarse + 1, weight, low, group),
            lambda u, coarse, weight, low, group: low,
        )

    def _coarse(self, level: Float) -> tuple[UInt32, Float]:
        """(coarser level, weight of the finer one), which is 0 at whole levels."""
        level = dr.clip(level, 0.0, len(self.shapes) - 1.0)
        coarse = dr.minimum(mi.UInt32(level), len(self.shapes) - 1)
        return coarse, level - mi.Float(coarse)

    def _level(
        self, u: Point2f, level: UInt32, scale: Float, out: list[Float], group: UInt32 | None = None
    ) -> list[Float]:
        rows, columns, start, _ = dr.gather(mi.Vector4u, self.table, level)
        return self._bilinear(in_image(u), rows, columns, start, scale, out, group)

    def _bilinear(
        self,
        x: Point2f,
        rows: UInt32,
        columns: UInt32,
        start: UInt32,
        scale: Float,
        out: list[Float],
        group: UInt32 | None = None,
    ) -> list[Float]:
        """`out` plus the texture of one level times a scale, at image positions x in [0, 1]."""
        px, py = dr.fma(x.x, mi.Float(columns), -0.5), dr.fma(x.y, mi.Float(rows), -0.5)
        left, top = dr.floor(px), dr.floor(py)
        fx, fy = px - left, py - top
        i, j = mi.Int32(left), mi.Int32(top)
        # x is in [0, 1]: only the first and the last texel have neighbors beyond the border.
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
            groups = range(self.groups) if group is None else [group]
            texel = [value for k in groups for value in self._group(index, mi.UInt32(k))]
            # Without the padding of the last group.
            out = [dr.fma(value, weight, total) for value, total in zip(texel, out, strict=False)]
        return out

    def _group(self, index: UInt32, group: UInt32) -> list[Float]:
        texel, after = self._strides
        return list(dr.gather(mi.Vector4f, self.buffer, index * texel + group * after))

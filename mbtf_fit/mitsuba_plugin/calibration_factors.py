"""Calibration factors of a value by level and elevation of light and view, in Dr.Jit kernels.

The formula is that of :mod:`mbtf_fit.models.calibration_factors`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mbtf_fit.mitsuba_plugin.material_arrays import F32
from mbtf_gen.render.types import Color3f, Float, UInt32


class CalibrationFactors:
    """Calibration tables of a material.

    Parameters
    ----------
    tables : (2, levels, knots, 3), by light, by view
    """

    def __init__(self, tables: F32) -> None:
        _, self._levels, self._knots, _ = tables.shape
        self._buffer = mi.Float(np.pad(tables, ((0, 0), (0, 0), (0, 0), (0, 1))).reshape(-1))
        dr.eval(self._buffer)

    def by_light(self, level: Float, cosine: Float) -> Color3f:
        """Factors (Color3f) of the light's cosine at fractional levels."""
        return self._at(0, level, cosine)

    def by_view(self, level: Float, cosine: Float) -> Color3f:
        """Factors (Color3f) of the view's cosine."""
        return self._at(1, level, cosine)

    def _at(self, table: int, level: Float, cosine: Float) -> Color3f:
        x = dr.clip(cosine, 0.0, 1.0) * (self._knots - 1)
        left = dr.minimum(mi.UInt32(x), self._knots - 2)
        inside = x - mi.Float(left)
        if self._levels == 1:
            return self._along(table * self._knots + left, inside)
        level = dr.clip(level, 0.0, self._levels - 1.0)
        coarse = dr.minimum(mi.UInt32(level), self._levels - 2)
        first = (table * self._levels + coarse) * self._knots + left
        pair = (self._along(first, inside), self._along(first + self._knots, inside))
        return dr.lerp(*pair, level - mi.Float(coarse))

    def _along(self, first: UInt32, inside: Float) -> Color3f:
        pair = (dr.gather(mi.Vector4f, self._buffer, first + k) for k in (0, 1))
        found = dr.lerp(*pair, inside)
        return mi.Color3f(found.x, found.y, found.z)

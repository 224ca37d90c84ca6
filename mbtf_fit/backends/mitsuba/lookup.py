"""Lookups in Dr.Jit kernels: textures of the material (:mod:`mbtf_fit.ops.lookup`), and tables of calibration
factors."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mbtf_core.data.lattice import Lattice
from mbtf_fit import ops
from mbtf_fit.backends.mitsuba.backend import MITSUBA, Loader, Numbers, Step
from mbtf_gen.engine.types import Float, UInt32


@MITSUBA.implements(ops.Lookup)
def _lookup(op: ops.Lookup, loader: Loader) -> Step:
    finer = op.oversampling.bit_length() - 1
    grids = Lattice(loader.lattice.finest + finer, loader.lattice.aspect)
    shapes = [grids.shape(s) for s in range(finer, grids.finest + 1)]
    textures = loader.texture(op.textures, shapes[-1:] if op.level is None else shapes, op.channels)
    if op.level is None:
        return lambda u, _: textures.first(mi.Point2f(*u))
    read = textures.blended if op.blending == "blend" else textures.side_by_side
    return lambda u, level: read(mi.Point2f(*u), *level)


@MITSUBA.implements(ops.Calibrate)
def _calibrate(op: ops.Calibrate, loader: Loader) -> Step:
    table = loader.stored.take(op.factors, (2, loader.lattice.finest + 1, None, 3))[op.table]
    levels, knots, _ = table.shape
    buffer = mi.Float(np.pad(table, ((0, 0), (0, 0), (0, 1))).reshape(-1))
    dr.eval(buffer)

    def along(first: UInt32, inside: Float) -> mi.Vector4f:
        pair = (dr.gather(mi.Vector4f, buffer, first + k) for k in (0, 1))
        return dr.lerp(*pair, inside)

    def step(level: Numbers, omega: Numbers) -> Numbers:
        x = dr.clip(omega[2], 0.0, 1.0) * (knots - 1)
        left = dr.minimum(mi.UInt32(x), knots - 2)
        inside = x - mi.Float(left)
        if levels == 1:
            return list(along(left, inside))[:3]
        at = dr.clip(level[0], 0.0, levels - 1.0)
        coarse = dr.minimum(mi.UInt32(at), levels - 2)
        first = coarse * knots + left
        pair = (along(first, inside), along(first + knots, inside))
        return list(dr.lerp(*pair, at - mi.Float(coarse)))[:3]

    return step

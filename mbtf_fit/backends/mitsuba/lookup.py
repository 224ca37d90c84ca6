"""Lookups in Dr.Jit kernels, and where they are read (:mod:`mbtf_fit.ops.lookup`): textures, parallax, tables
of calibration factors."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mbtf_fit import ops
from mbtf_fit.backends.mitsuba.backend import MITSUBA, Loader, Numbers, Step
from mbtf_fit.backends.mitsuba.shell import Shell, displaced
from mbtf_gen.engine.types import Float, UInt32


@MITSUBA.implements(ops.Lookup)
def _lookup(op: ops.Lookup, loader: Loader) -> Step:
    finer = op.oversampling.bit_length() - 1
    shapes = loader.grids(finer)[finer:]
    textures = loader.texture(op.textures, shapes[-1:] if op.level is None else shapes, op.channels)
    if op.level is None:
        return lambda u, _: textures.first(mi.Point2f(*u))
    return lambda u, level: textures.blended(mi.Point2f(*u), level[0] + op.finer)


@MITSUBA.implements(ops.SurfaceMaps)
def _surface_maps(op: ops.SurfaceMaps, loader: Loader) -> Step:
    maps = loader.maps(op.maps, op.channels)
    return lambda u, level: maps.blended(mi.Point2f(*u), level[0] + op.finer)


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


@MITSUBA.implements(ops.Offset)
def _offset(op: ops.Offset, loader: Loader) -> Step:
    aspect = loader.lattice.aspect

    def step(u: Numbers, r: Numbers, omega_o: Numbers) -> Numbers:
        if len(r) == 1:
            r = [r[0] * (omega / dr.maximum(omega_o[2], op.grazing)) for omega in omega_o[:2]]
        return [dr.fma(r[0], op.scale, u[0]), dr.fma(r[1], op.scale / aspect, u[1])]

    return step


@MITSUBA.implements(ops.Trace)
def _trace(op: ops.Trace, loader: Loader) -> Step:
    shell = shell_of(op, loader)

    def step(u: Numbers, level: Numbers, omega_o: Numbers) -> tuple[Numbers, Numbers, Numbers]:
        places = list(shell.places(u, level[0], omega_o))
        heights = shell.flat_heights(places, omega_o)
        hits = [displaced(at, z, omega_o, shell.aspect) for at, z in zip(places, heights, strict=True)]
        return [sum(heights) / len(heights)], [x for hit in hits for x in hit], heights

    return step


def shell_of(op: ops.Trace, loader: Loader) -> Shell:
    """The heights that an operation traces."""
    return Shell(op, loader.heightfield(op.heights), loader.lattice.aspect)


@MITSUBA.implements(ops.Displace)
def _displace(op: ops.Displace, loader: Loader) -> Step:
    finest, aspect = loader.lattice.finest, loader.lattice.aspect
    weights = mi.Float(loader.stored.take(op.weights, (finest + 1,)))

    def step(u: Numbers, z: Numbers, level: Numbers, omega_o: Numbers) -> Numbers:
        if finest == 0:
            weight = dr.gather(mi.Float, weights, mi.UInt32(0))
        else:
            coarse = dr.minimum(mi.UInt32(level[0]), finest - 1)
            pair = (dr.gather(mi.Float, weights, coarse + k) for k in (0, 1))
            weight = dr.lerp(*pair, level[0] - mi.Float(coarse))
        return displaced(u, weight * z[0], omega_o, aspect)

    return step

"""Inputs of networks in Dr.Jit kernels: directions in frames, frequencies (:mod:`mbtf_fit.ops.encode`)."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mbtf_fit import ops
from mbtf_fit.backends.mitsuba.backend import MITSUBA, Loader, Numbers, Step


@MITSUBA.implements(ops.HalfVector)
def _half_vector(op: ops.HalfVector, loader: Loader) -> Step:
    return lambda omega_i, omega_o: list(dr.normalize(mi.Vector3f(*omega_i) + mi.Vector3f(*omega_o)))


@MITSUBA.implements(ops.Rotate)
def _rotate(op: ops.Rotate, loader: Loader) -> Step:
    def step(axis: Numbers, omega: Numbers) -> Numbers:
        x, y, *upright = axis
        z = upright[0] if upright else dr.safe_sqrt(1.0 - dr.fma(x, x, y * y))
        along = dr.fma(x, omega[0], y * omega[1])
        share = omega[2] + along / (1.0 + z)
        return [dr.fma(-x, share, omega[0]), dr.fma(-y, share, omega[1]), dr.fma(z, omega[2], along)]

    return step


@MITSUBA.implements(ops.Stereographic)
def _stereographic(op: ops.Stereographic, loader: Loader) -> Step:
    return lambda omega: [c * dr.rcp(1.0 + omega[2]) for c in omega[:2]]


@MITSUBA.implements(ops.Position)
def _position(op: ops.Position, loader: Loader) -> Step:
    return lambda u: [2.0 * (x - dr.floor(x)) - 1.0 for x in u]


@MITSUBA.implements(ops.Frequencies)
def _frequencies(op: ops.Frequencies, loader: Loader) -> Step:
    aspect = loader.lattice.aspect
    bands = [(k, (math.pi if op.pi else 1.0) * 2.0**k) for k in range(op.bands)]

    def step(x: Numbers, level: Numbers | None) -> Numbers:
        sines, cosines = [], []
        across = None if level is None else dr.exp2(-level[0])
        for c, length in zip(x, (1.0, aspect) if level else [1.0] * len(x), strict=True):
            for k, frequency in bands:
                scale = 0.5**k if op.attenuated else 1.0
                factor = scale if across is None else scale * _average(across / length * frequency)
                s, t = dr.sincos(c * frequency)
                sines.append(s * factor)
                cosines.append(t * factor)
        return [*(x if op.raw else ()), *sines, *cosines]

    return step


def _average(x: mi.Float) -> mi.Float:
    """Of a wave over a Gaussian of a standard deviation, in radians."""
    return dr.exp(-0.5 * dr.square(x))

"""Directions about fibers, in Dr.Jit kernels (:mod:`mbtf_fit.ops.fibers`)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mbtf_fit import ops
from mbtf_fit.backends.mitsuba.backend import MITSUBA, Loader, Numbers, Step
from mbtf_fit.ops.constants import FIBER_CHANNELS
from mbtf_gen.engine.types import Float, Vector3f

# Symmetric matrix: xx, xy, xz, yy, yz, zz.
_Symmetric = Sequence[Float]


@MITSUBA.implements(ops.FiberFrame)
def _fiber_frame(op: ops.FiberFrame, loader: Loader) -> Step:
    maps = loader.maps(op.maps, FIBER_CHANNELS)

    def at(found: Numbers, omega_i: Vector3f, omega_o: Vector3f) -> Numbers:
        coverage = dr.maximum(_trace(found), 0.0)
        covered = dr.rcp(dr.maximum(coverage, op.least_tangents))
        mean = [x * covered for x in found[:6]]
        axis = mean
        for _ in range(3):
            square = _product(axis, axis)
            scale = dr.rcp(dr.maximum(_trace(square), 1e-12))
            axis = [x * scale for x in square]
        light, view = (dr.clip(_form(axis, w, w), 0.0, 1.0) for w in (omega_i, omega_o))
        both = _form(axis, omega_i, omega_o)
        cosines = dr.maximum(dr.sqrt((1.0 - light) * (1.0 - view)), op.least_cosine)
        azimuth = dr.clip((dr.dot(omega_i, omega_o) - both) / cosines, -1.0, 1.0)
        off, half = light + view + 2.0 * both, omega_i + omega_o
        spread = dr.maximum(_form(mean, half, half) - off * _trace(_product(mean, axis)), 0.0)
        variance = dr.maximum(dr.fma(found[6], covered, spread), op.least_variance)
        lobe = coverage * dr.exp(-0.5 * off / variance) * dr.rsqrt(2.0 * math.pi * variance)
        return [lobe, azimuth, light, view, both, coverage]

    def step(hits: Numbers, level: Numbers, omega_i: Numbers, omega_o: Numbers) -> Numbers:
        directions = mi.Vector3f(*omega_i), mi.Vector3f(*omega_o)
        places = (mi.Point2f(*hits[k : k + 2]) for k in range(0, len(hits), 2))
        parts = [at(maps.blended(place, level[0] + op.finer), *directions) for place in places]
        return [sum(column) / len(parts) for column in zip(*parts, strict=True)]

    return step


def _trace(m: _Symmetric) -> Float:
    return m[0] + m[3] + m[5]


def _form(m: _Symmetric, a: Vector3f, b: Vector3f) -> Float:
    """aᵀ M b"""
    diagonal = m[0] * a.x * b.x + m[3] * a.y * b.y + m[5] * a.z * b.z
    mixed = m[1] * dr.fma(a.x, b.y, a.y * b.x) + m[2] * dr.fma(a.x, b.z, a.z * b.x)
    return diagonal + mixed + m[4] * dr.fma(a.y, b.z, a.z * b.y)


def _product(a: _Symmetric, b: _Symmetric) -> list[Float]:
    """Product of matrices that commute."""
    rows = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
    return [
        sum(a[k] * b[n] for k, n in zip(rows[i], rows[j], strict=True)) for i in range(3) for j in range(i, 3)
    ]

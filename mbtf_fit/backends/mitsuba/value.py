"""From a network's outputs to the value in 1/sr, in Dr.Jit kernels (:mod:`mbtf_fit.ops.value`)."""

from __future__ import annotations

import math
from collections.abc import Callable

import drjit as dr

from mbtf_fit import ops
from mbtf_fit.backends.mitsuba.backend import MITSUBA, Loader, Numbers, Step, opaque
from mbtf_gen.engine.types import Float

FUNCTIONS: dict[str, Callable[[Float], Float]] = {
    "identity": lambda x: x,
    "exp": lambda x: dr.exp(x),
    "expm1": lambda x: dr.exp(x) - 1.0,
    "log1p": lambda x: dr.log(1.0 + x),
    "softplus": lambda x: dr.maximum(x, 0.0) + dr.log(1.0 + dr.exp(-dr.abs(x))),
    "sigmoid": lambda x: dr.rcp(1.0 + dr.exp(-x)),
    "fourth-root": lambda x: x * dr.square(x) * dr.abs(x),
    "square": lambda x: dr.square(x),
}


@MITSUBA.implements(ops.Transform)
def _transform(op: ops.Transform, loader: Loader) -> Step:
    function = FUNCTIONS[op.function]
    divisor = 1.0 if op.divisor is None else loader.scalar(op.divisor)
    by = opaque(divisor) if op.divisor and divisor else 1.0
    # A quotient by 0 is 0.
    scale = op.scale if divisor else 0.0
    factor = 1.0 if op.factor is None else opaque(loader.scalar(op.factor))
    return lambda x: [factor * function(scale * (v / by)) for v in x]


@MITSUBA.implements(ops.Matrix)
def _matrix(op: ops.Matrix, loader: Loader) -> Step:
    return lambda x: [sum(a * v for a, v in zip(row, x, strict=True) if a) for row in op.rows]


@MITSUBA.implements(ops.Gate)
def _gate(op: ops.Gate, loader: Loader) -> Step:
    on = op.unit is None or loader.scalar(op.unit) > 0

    def step(gate: Numbers, x: Numbers, plus: Numbers | None) -> Numbers:
        shares = [op.floor + op.scale * FUNCTIONS["sigmoid"](g) for g in gate]
        shares = shares * len(x) if len(gate) == 1 else shares
        product = [share * v if on else 0.0 * v for share, v in zip(shares, x, strict=True)]
        return product if plus is None else [v + p for v, p in zip(product, plus, strict=True)]

    return step


@MITSUBA.implements(ops.Standardize)
def _standardize(op: ops.Standardize, loader: Loader) -> Step:
    return lambda x, mean, deviation: [dr.fma(d, v, m) for v, m, d in zip(x, mean, deviation, strict=True)]


@MITSUBA.implements(ops.DivideByCosine)
def _divide_by_cosine(op: ops.DivideByCosine, loader: Loader) -> Step:
    return lambda x, omega: [v / dr.maximum(omega[2], op.least) for v in x]


@MITSUBA.implements(ops.Product)
def _product(op: ops.Product, loader: Loader) -> Step:
    return lambda x: [math.prod(numbers) for numbers in zip(*x, strict=True)]

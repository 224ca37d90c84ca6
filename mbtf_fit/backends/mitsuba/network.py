"""Small fully connected networks in Dr.Jit kernels, their inputs (:mod:`mbtf_fit.ops.network`), and
what leads from their outputs to the value in 1/sr (:mod:`mbtf_fit.ops.value`).

- ``unrolled``: multiply-adds with the weights as literals of the kernel. Fastest on a CPU, for networks that
  compile in reasonable time. The kernel is compiled for one material.
- ``cooperative``: cooperative vectors of :mod:`drjit.nn` in single precision; one kernel for all materials.
- ``half``: cooperative vectors in half precision, for the tensor cores of GPUs. The first layer is unrolled
  in single precision, because rounded inputs would cause half of the error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import drjit as dr
import mitsuba as mi
from drjit import nn

from mbtf_fit import ops
from mbtf_fit.backends.mitsuba.backend import MITSUBA, Arithmetic, Loader, Numbers, Step, opaque
from mbtf_fit.backends.mitsuba.stored_material import F32, StoredMaterial
from mbtf_fit.ops.constants import LEAK
from mbtf_fit.ops.operation import parse, reached_from
from mbtf_gen.engine.types import Float

# (weight (outputs, inputs), bias (outputs,)) of each layer.
Layers = list[tuple[F32, F32]]
# Most weights of unrolled networks: larger ones take too long to compile.
MOST_UNROLLED = 12_000
# Outputs of a layer that are summed at a time: their sums do not wait for each other, and fit registers.
INTERLEAVED = 8


def default_arithmetic(stored: StoredMaterial) -> Arithmetic:
    """Default for the current variant and the number of a material's weights."""
    if mi.variant().startswith("cuda"):
        return "half"
    prefixes = tuple(f"{op.weights}." for op in stored.operations if isinstance(op, ops.Network))
    weights = sum(tensor.size for name, tensor in stored.tensors.items() if name.startswith(prefixes))
    return "unrolled" if weights <= MOST_UNROLLED else "cooperative"


@MITSUBA.implements(ops.Network)
def _network(op: ops.Network, loader: Loader) -> Step:
    take, layers, arithmetic = loader.stored.take, [], loader.arithmetic
    for k, (inputs, outputs) in enumerate(pairwise(op.widths(sum(loader.inputs(op))))):
        name = f"{op.weights}.{k}"
        layers.append((take(f"{name}.weight", (outputs, inputs)), take(f"{name}.bias", (outputs,))))
    # Single precision for small networks that move lookups: values are sensitive to errors of the position.
    small = sum(weight.size + bias.size for weight, bias in layers) <= MOST_UNROLLED
    operations = loader.stored.operations
    moved = reached_from(operations, op.output)
    moves = any(isinstance(o, ops.Lookup) and parse(o.u)[0] in moved for o in operations)
    if arithmetic == "half" and small and moves:
        arithmetic = "unrolled"
    network = PackedNetwork(layers, arithmetic, op.activation)
    return lambda x: network([number for value in x for number in value])


class PackedNetwork:
    """A fully connected network with an activation after every layer but the last.

    Parameters
    ----------
    layers : weights and biases
    arithmetic : ``unrolled``, ``cooperative`` or ``half``
    activation : ``relu``, ``leaky-relu`` or ``sine``
    """

    def __init__(self, layers: Layers, arithmetic: Arithmetic, activation: str = "relu") -> None:
        self.layers = layers
        self.activation = activation
        self.arithmetic = arithmetic
        # Layers that are unrolled; the others are cooperative.
        self._single = {"unrolled": len(layers), "cooperative": 0, "half": 1}[arithmetic]
        rest = layers[self._single :]
        if rest:
            tensor = mi.TensorXf16 if arithmetic == "half" else mi.TensorXf
            parts = [tensor(array) for weight, bias in rest for array in (weight, bias[:, None])]
            self._views = nn.pack(*parts, layout="inference")

    def __call__(self, inputs: Sequence[Float]) -> Numbers:
        """Outputs of the last layer."""
        x = self._unrolled(inputs)
        return x if self._single == len(self.layers) else self._cooperative(x)

    def _activated(self, x: Float) -> Float:
        """Activation of a number per lane."""
        if self.activation == "sine":
            return dr.sin(x)
        # A single instruction in place of the four of `dr.maximum`, which looks for NaN.
        return dr.select(x < 0.0, 0.0 if self.activation == "relu" else LEAK * x, x)

    def _unrolled(self, inputs: Sequence[Float]) -> Numbers:
        x = list(inputs)
        for k, (weight, bias) in enumerate(self.layers[: self._single]):
            y: Numbers = []
            for first in range(0, len(weight), INTERLEAVED):
                part = slice(first, first + INTERLEAVED)
                totals = [mi.Float(b) for b in bias[part].tolist()]
                for value, column in zip(x, weight[part].T.tolist(), strict=True):
                    # Instructions of later scopes follow those of earlier ones.
                    dr.detail.new_scope(dr.backend_v(mi.Float))
                    totals = [dr.fma(value, w, total) for total, w in zip(totals, column, strict=True)]
                y += totals
            x = y if k == len(self.layers) - 1 else [self._activated(value) for value in y]
        return x

    def _cooperative(self, inputs: Sequence[Float]) -> Numbers:
        number = mi.Float16 if self.arithmetic == "half" else mi.Float
        x = nn.CoopVec(*(number(value) for value in inputs))
        count = len(self.layers) - self._single
        for k in range(count):
            x = nn.matvec(self._views[2 * k], x, self._views[2 * k + 1])
            if k < count - 1:
                x = dr.maximum(x, 0.0) if self.activation == "relu" else nn.CoopVec(*map(self._activated, x))
        return [mi.Float(value) for value in x]


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


@MITSUBA.implements(ops.ToFrame)
def _to_frame(op: ops.ToFrame, loader: Loader) -> Step:
    def step(axes: Numbers, omega: Numbers) -> Numbers:
        a, b, direction = mi.Vector3f(*axes[:3]), mi.Vector3f(*axes[3:]), mi.Vector3f(*omega)
        normal, toward = a + mi.Vector3f(0.0, 0.0, 1.0), b + mi.Vector3f(1.0, 0.0, 0.0)
        normal /= dr.maximum(dr.norm(normal), op.shortest)
        tangent = toward - dr.dot(toward, normal) * normal
        tangent /= dr.maximum(dr.norm(tangent), op.shortest * (1.0 + dr.norm(toward)))
        return [dr.dot(axis, direction) for axis in (tangent, dr.cross(normal, tangent), normal)]

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
                factor = scale
                if across is not None:
                    # The average of the wave over the Gaussian of the footprint.
                    factor = scale * dr.exp(-0.5 * dr.square(across / length * frequency))
                s, t = dr.sincos(c * frequency)
                sines.append(s * factor)
                cosines.append(t * factor)
        return [*(x if op.raw else ()), *sines, *cosines]

    return step


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
    most = None if op.most is None else opaque(loader.scalar(op.most))

    def values(x: Numbers) -> Numbers:
        found = [function(scale * (v / by)) for v in x]
        return [factor * (v if most is None else dr.minimum(v, most)) for v in found]

    return values


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

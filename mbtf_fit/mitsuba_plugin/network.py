"""Small fully connected networks in Dr.Jit kernels, their inputs and outputs by the options of
``config.network``; the key ``formula`` of each ``material.json`` states the formulas.

- ``unrolled``: multiply-adds with the weights as literals of the kernel. Fastest on a CPU, for networks that
  compile in reasonable time. The kernel is compiled for one material.
- ``cooperative``: cooperative vectors of :mod:`drjit.nn` in single precision; one kernel for all materials.
- ``half``: cooperative vectors in half precision, for the tensor cores of GPUs. The first layer is unrolled
  in single precision, because rounded inputs would cause half of the error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
from drjit import nn

from mbtf_fit.mitsuba_plugin.material_arrays import Layers
from mbtf_fit.ops.constants import GATE, LEAK, RGB_OF_YUV
from mbtf_fit.sections import EncodingSection, NetworkSection
from mbtf_gen.engine.types import Color3f, Float, Point2f, Vector3f

Arithmetic = Literal["unrolled", "cooperative", "half"]
# Most weights of unrolled networks: larger ones take too long to compile.
MOST_UNROLLED = 12_000


def default_arithmetic(weights: int) -> Arithmetic:
    """Default for the current variant and a number of weights."""
    if mi.variant().startswith("cuda"):
        return "half"
    return "unrolled" if weights <= MOST_UNROLLED else "cooperative"


def count_weights(layers: Layers) -> int:
    """Number of weights, biases included."""
    return sum(weight.size + bias.size for weight, bias in layers)


class Network:
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

    def __call__(self, inputs: Sequence[Float]) -> list[Float]:
        """Outputs of the last layer."""
        x = self._unrolled(inputs)
        return x if self._single == len(self.layers) else self._cooperative(x)

    def _activated(self, x: Any) -> Any:
        """Activation of a number per lane, or of a cooperative vector where it is ``relu``."""
        if self.activation == "relu":
            return dr.maximum(x, 0.0)
        return dr.sin(x) if self.activation == "sine" else dr.maximum(x, LEAK * x)

    def _unrolled(self, inputs: Sequence[Float]) -> list[Float]:
        x = list(inputs)
        for k, (weight, bias) in enumerate(self.layers[: self._single]):
            y = []
            for row, b in zip(weight.tolist(), bias.tolist(), strict=True):
                total = mi.Float(b)
                for value, w in zip(x, row, strict=True):
                    total = dr.fma(value, w, total)
                y.append(total if k == len(self.layers) - 1 else self._activated(total))
            x = y
        return x

    def _cooperative(self, inputs: Sequence[Float]) -> list[Float]:
        number = mi.Float16 if self.arithmetic == "half" else mi.Float
        x = nn.CoopVec(*(number(value) for value in inputs))
        count = len(self.layers) - self._single
        for k in range(count):
            x = nn.matvec(self._views[2 * k], x, self._views[2 * k + 1])
            if k < count - 1:
                x = self._activated(x) if self.activation == "relu" else nn.CoopVec(*map(self._activated, x))
        return [mi.Float(value) for value in x]


def encode(
    p: Sequence[Float],
    bands: int,
    pi: bool,
    options: EncodingSection,
    spread: Sequence[Float] | None = None,
) -> list[Float]:
    """Coordinates → [themselves,] sines of doubling frequencies, cosines; without bands themselves alone.
    With `spread`, their means over Gaussians of these standard deviations."""
    if bands == 0:
        return list(p)
    unit = math.pi if pi else 1.0
    frequencies = [unit * 2.0**k for k in range(bands)]
    pairs = [dr.sincos(x * f) for x in p for f in frequencies]
    if options.band_attenuation:
        pairs = [(s * 0.5**k, c * 0.5**k) for (s, c), k in zip(pairs, [*range(bands)] * len(p), strict=True)]
    if spread is not None:
        left = [dr.exp(-0.5 * dr.square(s * f)) for s in spread for f in frequencies]
        pairs = [(s * a, c * a) for (s, c), a in zip(pairs, left, strict=True)]
    return [*(p if options.raw else ()), *(s for s, _ in pairs), *(c for _, c in pairs)]


def encode_direction(omega: Vector3f, options: EncodingSection) -> list[Float]:
    """Encoded direction."""
    coordinates = [omega.x, omega.y, omega.z] if options.direction_xyz else [omega.x, omega.y]
    return encode(coordinates, options.direction, options.direction_pi, options)


def rotate_to_z(axis: Vector3f, omega: Vector3f) -> Vector3f:
    """Directions, rotated by the shortest rotation that takes unit vectors with z > 0 to z."""
    along = dr.fma(axis.x, omega.x, axis.y * omega.y)
    share = omega.z + along / (1.0 + axis.z)
    return mi.Vector3f(
        dr.fma(-axis.x, share, omega.x), dr.fma(-axis.y, share, omega.y), dr.fma(axis.z, omega.z, along)
    )


def encode_directions(omega_i: Vector3f, omega_o: Vector3f, options: EncodingSection) -> list[Float]:
    """Encoded light and view; with ``half_vector``, half vector and difference vector."""
    out = [*encode_direction(omega_i, options), *encode_direction(omega_o, options)]
    if options.half_vector:
        half = dr.normalize(omega_i + omega_o)
        out += [*half, *rotate_to_z(half, omega_i)]
    return out


def encode_position(u: Point2f, level: Float, aspect: float, options: EncodingSection) -> list[Float]:
    """Encoded uv position at a fractional level: empty without bands."""
    if options.position == 0:
        return []
    p = [2.0 * (x - dr.floor(x)) - 1.0 for x in (u.x, u.y)]
    across = dr.exp2(-level)
    spread = [across, across / aspect] if options.footprint_filtered else None
    return encode(p, options.position, options.pi, options, spread)


_TRANSFORMS: dict[str, Callable[[Float], Float]] = {
    "expm1": lambda x: dr.exp(x) - 1.0,
    "exp": lambda x: dr.exp(x),
    "softplus": lambda x: dr.maximum(x, 0.0) + dr.log(1.0 + dr.exp(-dr.abs(x))),
    "fourth-root": lambda x: x * dr.square(x) * dr.abs(x),
    "identity": lambda x: x,
}


def to_value(x: Sequence[Float], unit: float, network: NetworkSection, *, clamp: bool = True) -> Color3f:
    """Value in 1/sr, at least 0 if it is clamped, of a decoder's three or six outputs."""
    gates = [GATE + dr.rcp(1.0 + dr.exp(-v)) for v in x[3:]]
    if gates:
        x = [sum(weight * v for weight, v in zip(row, x[:3], strict=True) if weight) for row in RGB_OF_YUV]
    colors = [unit * _TRANSFORMS[network.output_transform](v) for v in x]
    if gates:
        colors = [color * gate for color, gate in zip(colors, gates, strict=True)]
    return mi.Color3f(*(dr.maximum(v, 0.0) if clamp else v for v in colors))

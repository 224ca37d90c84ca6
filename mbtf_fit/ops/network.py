"""Networks and their inputs: fully connected ones, Inception modules; directions in frames, frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from mbtf_fit.ops.operation import NetworkName, Operation, Value, Values

Activation = Literal["relu", "leaky-relu", "sine"]


@dataclass(frozen=True)
class Network(Operation):
    """Fully connected layers ``x → W x + b``, an activation after each but the last.

    Activations: ``max(0, x)``, ``max(0.01 x, x)``, ``sin x``. Tensors: ``weights.0.weight`` (outputs,
    inputs), ``weights.0.bias``, ``weights.1.weight``, …

    Attributes
    ----------
    x : inputs, concatenated
    weights : name of the network
    hidden : units of the layers between
    outputs : numbers of the last layer
    """

    x: Values
    weights: NetworkName
    hidden: tuple[int, ...]
    outputs: int
    activation: Activation = "relu"

    def size(self, sizes: Sequence[int]) -> int:
        return self.outputs

    def widths(self, inputs: int) -> list[int]:
        """Features of the input, of each layer between, and of the output."""
        return [inputs, *self.hidden, self.outputs]


@dataclass(frozen=True)
class Inception(Operation):
    """1×1 convolution, Inception modules, 1×1 convolution over a :class:`~mbtf_fit.ops.lookup.Neighborhood`
    (Xue et al. 2024).

    An activation follows all convolutions but the last; the output is that of the middle. A module (Szegedy
    et al., CVPR 2015) joins ``one(x)``, ``three(before3(x))``, ``five(before5(x))`` and ``pooled(3×3 maximum
    of x)``; there is no padding. Tensors: ``weights.first.weight`` (outputs, inputs, 1, 1),
    ``weights.0.one.weight``, …, ``weights.last.bias``.

    Attributes
    ----------
    features : inputs at every position, concatenated
    shared : inputs of the query, concatenated
    weights : name of the network
    width, modules, outputs : channels between, number of modules, numbers of the last layer
    """

    features: Values
    shared: Values
    weights: NetworkName
    width: int
    modules: int
    outputs: int
    activation: Activation = "relu"

    def size(self, sizes: Sequence[int]) -> int:
        return self.outputs


@dataclass(frozen=True)
class HalfVector(Operation):
    """``(ω_i + ω_o) / ‖ω_i + ω_o‖`` (3)."""

    omega_i: Value
    omega_o: Value

    def size(self, sizes: Sequence[int]) -> int:
        return 3


@dataclass(frozen=True)
class Rotate(Operation):
    """A direction, rotated by the shortest rotation that takes an axis to z (3).

    ``(ω_xy - a_xy (ω_z + t / (1 + a_z)), a_z ω_z + t)``, ``t = a_xy · ω_xy``. About the half vector, the
    light becomes the difference vector (Rusinkiewicz, EGSR 1998), in a frame that is continuous everywhere.

    Attributes
    ----------
    axis : unit vector with z > 0 (3); of two numbers, z is ``√max(0, 1 - x² - y²)``
    omega : direction (3)
    """

    axis: Value
    omega: Value

    def size(self, sizes: Sequence[int]) -> int:
        return 3


@dataclass(frozen=True)
class ToFrame(Operation):
    """A direction in a frame of a normal and a tangent: ``(t·ω, (n × t)·ω, n·ω)`` (3).

    ``n = N / max(‖N‖, ε)`` with ``N = a + e_z``, and ``t = T / max(‖T‖, ε (1 + ‖b + e_x‖))`` with
    ``T = b + e_x - (n·(b + e_x)) n``. Where a and b are 0, the frame is the tile's. Axes have length 1, but
    for N that is almost 0, and for b + e_x that is almost 0 or parallel to n: they fade to 0.

    Attributes
    ----------
    axes : a and b (6)
    omega : direction (3)
    shortest : ε, which keeps rounding errors from becoming axes
    """

    axes: Value
    omega: Value
    shortest: float = 1e-2

    def size(self, sizes: Sequence[int]) -> int:
        if sizes != [6, 3]:
            raise ValueError(f"'{self.output}' needs axes of 6 numbers and a direction of 3, not {sizes}")
        return 3


@dataclass(frozen=True)
class Stereographic(Operation):
    """A direction, projected from the nadir: ``ω_xy / (1 + ω_z)`` (2)."""

    omega: Value

    def size(self, sizes: Sequence[int]) -> int:
        return 2


@dataclass(frozen=True)
class Position(Operation):
    """``p = 2 (u mod 1) - 1`` (2): with frequencies of π, periodic over the tile."""

    u: Value

    def size(self, sizes: Sequence[int]) -> int:
        return 2


@dataclass(frozen=True)
class Frequencies(Operation):
    """Sines of doubling frequencies, then cosines.

    From NeRF (Mildenhall et al., ECCV 2020), for materials by Xue et al. 2024: ``sin(f_k x)`` with ``f_k =
    2^k`` or ``2^k π``, k = 0..bands-1 of the first coordinate, then of the next; then the cosines likewise.
    With a level, each is averaged over the footprint of a :class:`Position`, that is multiplied by
    ``exp(-(f_k s)²/2)``, ``s = 2^-l / (1, aspect)`` (mip-NeRF: Barron et al., ICCV 2021).

    Attributes
    ----------
    x, level : coordinates, fractional level (1) or None
    bands : frequencies of each coordinate
    pi : frequencies of π
    raw : put the coordinates themselves first
    attenuated : divide band k by 2^k
    """

    x: Value
    level: Value | None
    bands: int
    pi: bool = True
    raw: bool = False
    attenuated: bool = False

    def size(self, sizes: Sequence[int]) -> int:
        return sizes[0] * (2 * self.bands + self.raw)

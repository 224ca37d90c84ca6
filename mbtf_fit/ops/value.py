"""From a network's outputs to the value in 1/sr."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from mbtf_fit.ops.constants import RGB_OF_YUV
from mbtf_fit.ops.operation import Operation, TensorName, Value, Values

Function = Literal["identity", "exp", "expm1", "log1p", "softplus", "sigmoid", "fourth-root", "square"]


@dataclass(frozen=True)
class Transform(Operation):
    """A function of each number: ``factor · min(f(scale · x / divisor), most)``.

    ``expm1`` is exp(x) - 1, ``log1p`` log(1 + x), ``softplus`` log(1 + exp(x)), ``sigmoid`` 1 / (1 +
    exp(-x)), ``fourth-root`` the inverse x|x|³ of the fourth root. Where the divisor is 0, its quotient is
    0.

    Attributes
    ----------
    x : any size
    function : f
    scale : number
    divisor, factor : tensors (), or None for 1
    most : tensor (), or None for no bound
    """

    x: Value
    function: Function = "identity"
    scale: float = 1.0
    divisor: TensorName | None = None
    factor: TensorName | None = None
    most: TensorName | None = None

    def size(self, sizes: Sequence[int]) -> int:
        return sizes[0]


@dataclass(frozen=True)
class Matrix(Operation):
    """``y = A x``; the default turns Rec.601 YUV into RGB, as in NeuMIP's published code."""

    x: Value
    rows: tuple[tuple[float, ...], ...] = RGB_OF_YUV

    def size(self, sizes: Sequence[int]) -> int:
        if any(len(row) != sizes[0] for row in self.rows):
            raise ValueError(f"matrix '{self.output}' does not have {sizes[0]} columns")
        return len(self.rows)


@dataclass(frozen=True)
class Gate(Operation):
    """A learned share: ``(floor + scale · σ(g)) · x + plus``, ``σ(g) = 1 / (1 + exp(-g))``.

    Attributes
    ----------
    gate, x, plus : g (1, or as many as x), x, an addend or None
    unit : tensor (): where it is 0, so is the share; None for no such test
    """

    gate: Value
    x: Value
    plus: Value | None = None
    floor: float = 0.0
    scale: float = 1.0
    unit: TensorName | None = None

    def size(self, sizes: Sequence[int]) -> int:
        return sizes[1]


@dataclass(frozen=True)
class Standardize(Operation):
    """The inverse of a standardization: ``mean + deviation · x`` (Rainer et al. 2019)."""

    x: Value
    mean: Value
    deviation: Value

    def size(self, sizes: Sequence[int]) -> int:
        return sizes[0]


@dataclass(frozen=True)
class DivideByCosine(Operation):
    """``x / max(ω_z, least)``."""

    x: Value
    omega: Value
    least: float

    def size(self, sizes: Sequence[int]) -> int:
        return sizes[0]


@dataclass(frozen=True)
class Calibrate(Operation):
    """Calibration factors (3) of an elevation (:mod:`mbtf_fit.training.calibration`).

    ``factors[table]`` at the level l and the cosine ω_z: linear between levels, and between knots at the
    cosines 0, 1/(knots-1), …, 1.

    Attributes
    ----------
    level, omega : fractional level (1), direction (3)
    factors : tensor (2, levels, knots, 3), of light and of view
    table : 0 or 1
    """

    level: Value
    omega: Value
    factors: TensorName
    table: int

    def size(self, sizes: Sequence[int]) -> int:
        return 3


@dataclass(frozen=True)
class Product(Operation):
    """Product of values of one size."""

    x: Values

    def size(self, sizes: Sequence[int]) -> int:
        return sizes[0]


def calibrated(operations: Sequence[Operation]) -> list[Operation]:
    """A list whose value is scaled by the calibration factors of light and view, tensor ``calibration``."""
    directions = ("by_view", "omega_o", 1), ("by_light", "omega_i", 0)
    factors = [Calibrate(name, "level", omega, "calibration", table) for name, omega, table in directions]
    names = operations[-1].output, *(factor.output for factor in factors)
    return [*operations, *factors, Product("calibrated", names)]

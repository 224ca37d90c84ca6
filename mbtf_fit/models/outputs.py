"""Output transforms: from the decoder's output to a value in 1/sr."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from mbtf_fit.config import OutputTransform
from mbtf_fit.models.constants import GATE, RGB_OF_YUV

# Initial output x, whose value is `unit`; for expm1 the initial value is 0.
START: dict[OutputTransform, float] = {
    "expm1": 0.0,
    "exp": 0.0,
    "identity": 1.0,
    "softplus": math.log(math.e - 1.0),
    "fourth-root": 1.0,
}

_MAPS: dict[OutputTransform, Callable[[Tensor], Tensor]] = {
    "expm1": torch.expm1,
    "exp": torch.exp,
    "identity": lambda x: x,
    "softplus": torch.nn.functional.softplus,
    # Odd, so that the gradient has the right sign for outputs below zero.
    "fourth-root": lambda x: x * x.abs().pow(3),
}

_FORMULAS: dict[OutputTransform, str] = {
    "expm1": "exp(x) - 1",
    "exp": "exp(x)",
    "identity": "x",
    "softplus": "log(1 + exp(x))",
    "fourth-root": "x |x|^3",
}


def to_value(x: Tensor, unit: Tensor, output: OutputTransform) -> Tensor:
    """Values (..., 3) of outputs (..., 3) or (..., 6).

    Three outputs are RGB: ``unit · transform(x)``. Of six, the first three are YUV and the others a gate per
    color: ``unit · transform(RGB(x_0..2)) · (0.1 + sigmoid(x_3..5))``, as in NeuMIP's published code.
    """
    if x.shape[-1] == 3:
        return unit * _MAPS[output](x)
    rgb = x[..., :3] @ x.new_tensor(RGB_OF_YUV).T
    return unit * _MAPS[output](rgb) * (GATE + torch.sigmoid(x[..., 3:]))


def start_of(output: OutputTransform, outputs: int) -> list[float]:
    """Initial biases of the last layer."""
    gray = START[output]
    return [gray] * 3 if outputs == 3 else [gray, 0.0, 0.0, 0.0, 0.0, 0.0]


def output_formula(output: OutputTransform, outputs: int) -> str:
    """Formula of the value as text, from the output ``x``."""
    if outputs == 3:
        return f"unit * ({_FORMULAS[output]})"
    rows = "; ".join(" ".join(f"{c:g}" for c in row) for row in RGB_OF_YUV)
    return (
        f"unit * ({_FORMULAS[output]}) * ({GATE} + 1 / (1 + exp(-y))), where y = the last three outputs and "
        f"x = the first three as YUV turned into RGB by the rows {rows}"
    )

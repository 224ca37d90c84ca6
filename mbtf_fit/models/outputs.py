"""From a decoder's answer to a value in 1/sr."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from mbtf_fit.config import OutputMap

# The answer x that stands for the value `unit`, from which training starts; for exp-1 it starts at the value
# 0.
START: dict[OutputMap, float] = {
    "exp-1": 0.0,
    "exp": 0.0,
    "identity": 1.0,
    "softplus": math.log(math.e - 1.0),
    "fourth-root": 1.0,
}

_MAPS: dict[OutputMap, Callable[[Tensor], Tensor]] = {
    "exp-1": torch.expm1,
    "exp": torch.exp,
    "identity": lambda x: x,
    "softplus": torch.nn.functional.softplus,
    # Odd, so that an answer below zero is pulled back instead of growing as its mirror image.
    "fourth-root": lambda x: x * x.abs().pow(3),
}

_FORMULAS: dict[OutputMap, str] = {
    "exp-1": "exp(x) - 1",
    "exp": "exp(x)",
    "identity": "x",
    "softplus": "log(1 + exp(x))",
    "fourth-root": "x |x|^3",
}

# Rec.601 YUV → RGB, one row per color, as the published code has it.
_RGB_OF_YUV = ((1.0, 0.0, 1.13983), (1.0, -0.39465, -0.58060), (1.0, 2.03211, 0.0))
# The gate's least value: it darkens, but never shuts off the gradient.
_GATE = 0.1


def to_value(x: Tensor, unit: Tensor, output: OutputMap) -> Tensor:
    """Values (..., 3) of answers (..., 3) or (..., 6).

    Three answers are RGB: ``unit · map(x)``. Of six, the first three are YUV and the others a gate per
    color: ``unit · map(RGB(x_0..2)) · (0.1 + sigmoid(x_3..5))``, as in NeuMIP's published code.
    """
    if x.shape[-1] == 3:
        return unit * _MAPS[output](x)
    rgb = x[..., :3] @ x.new_tensor(_RGB_OF_YUV).T
    return unit * _MAPS[output](rgb) * (_GATE + torch.sigmoid(x[..., 3:]))


def start_of(output: OutputMap, outputs: int) -> list[float]:
    """Biases of the last layer to start from."""
    gray = START[output]
    return [gray] * 3 if outputs == 3 else [gray, 0.0, 0.0, 0.0, 0.0, 0.0]


def output_formula(output: OutputMap, outputs: int) -> str:
    """The value as text, from the answer ``x``."""
    if outputs == 3:
        return f"unit * ({_FORMULAS[output]})"
    rows = "; ".join(" ".join(f"{c:g}" for c in row) for row in _RGB_OF_YUV)
    return (
        f"unit * ({_FORMULAS[output]}) * ({_GATE} + 1 / (1 + exp(-y))), where y = the last three answers and "
        f"x = the first three as YUV turned into RGB by the rows {rows}"
    )

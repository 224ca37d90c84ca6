"""Output transforms: from the decoder's output to a value in 1/sr."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from mbtf_fit.config import OutputTransform
from mbtf_fit.models.constants import GATE, RGB_OF_YUV

# Initial output x, whose value is `unit` (0 for expm1), the transform, and its formula.
_TRANSFORMS: dict[OutputTransform, tuple[float, Callable[[Tensor], Tensor], str]] = {
    "expm1": (0.0, torch.expm1, "exp(x) - 1"),
    "exp": (0.0, torch.exp, "exp(x)"),
    "identity": (1.0, lambda x: x, "x"),
    "softplus": (math.log(math.e - 1.0), torch.nn.functional.softplus, "log(1 + exp(x))"),
    # Odd, so that the gradient has the right sign for outputs below zero.
    "fourth-root": (1.0, lambda x: x * x.abs().pow(3), "x |x|^3"),
}


def to_value(x: Tensor, unit: Tensor, output: OutputTransform) -> Tensor:
    """Values (..., 3) of outputs (..., 3) or (..., 6).

    Three outputs are RGB: ``unit · transform(x)``. Of six, the first three are YUV and the others a gate per
    color: ``unit · transform(RGB(x_0..2)) · (0.1 + sigmoid(x_3..5))``, as in NeuMIP's published code.
    """
    transform = _TRANSFORMS[output][1]
    if x.shape[-1] == 3:
        return unit * transform(x)
    rgb = x[..., :3] @ x.new_tensor(RGB_OF_YUV).T
    return unit * transform(rgb) * (GATE + torch.sigmoid(x[..., 3:]))


def start_of(output: OutputTransform, outputs: int) -> list[float]:
    """Initial biases of the last layer."""
    gray = _TRANSFORMS[output][0]
    return [gray] * 3 if outputs == 3 else [gray, 0.0, 0.0, 0.0, 0.0, 0.0]


def output_formula(output: OutputTransform, outputs: int) -> str:
    """Formula of the value as text, from the output ``x``."""
    value = f"unit * ({_TRANSFORMS[output][2]})"
    if outputs == 3:
        return value
    rows = "; ".join(" ".join(f"{c:g}" for c in row) for row in RGB_OF_YUV)
    return (
        f"{value} * ({GATE} + 1 / (1 + exp(-y))), where y = the last three outputs and "
        f"x = the first three as YUV turned into RGB by the rows {rows}"
    )

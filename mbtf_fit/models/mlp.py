"""Small fully connected networks, row-major (queries, features)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal

import torch
from torch import Tensor, nn

from mbtf_fit.models.constants import LEAK

Activation = Literal["relu", "leaky-relu", "sine"]
ACTIVATIONS: dict[Activation, Callable[[Tensor], Tensor]] = {
    "relu": torch.relu,
    "leaky-relu": lambda x: nn.functional.leaky_relu(x, LEAK),
    "sine": torch.sin,
}


class _FusedMlp(torch.autograd.Function):
    """ReLU network with a hand-written backward pass, which stores the layers' outputs only."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, *parameters: Tensor) -> Tensor:
        inputs = []
        last = len(parameters) - 2
        for k in range(0, len(parameters), 2):
            inputs.append(x)
            x = torch.addmm(parameters[k + 1], x, parameters[k].t())
            if k < last:
                x.relu_()
        ctx.save_for_backward(*inputs, *parameters[::2])
        return x

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        count = len(ctx.saved_tensors) // 2
        inputs, weights = ctx.saved_tensors[:count], ctx.saved_tensors[count:]
        by_parameter: list[Tensor | None] = [None] * (2 * count)
        g = gradients[0].contiguous()
        ones = g.new_ones(len(g))
        for k in reversed(range(count)):
            by_parameter[2 * k] = g.t() @ inputs[k]
            by_parameter[2 * k + 1] = ones @ g
            if k == 0 and not ctx.needs_input_grad[0]:
                return None, *by_parameter
            g = g @ weights[k]
            if k:
                torch.ops.aten.threshold_backward.grad_input(g, inputs[k], 0, grad_input=g)
        return g, *by_parameter


class Mlp(nn.Module):
    """Fully connected network with an activation between its layers and none after the last.

    Parameters
    ----------
    widths : features of the input, of each hidden layer, and of the output
    """

    def __init__(self, widths: Sequence[int], activation: Activation = "relu") -> None:
        super().__init__()
        self.activation: Activation = activation
        pairs = list(pairwise(widths))
        self.weights = nn.ParameterList(nn.Parameter(torch.empty(o, i)) for i, o in pairs)
        self.biases = nn.ParameterList(nn.Parameter(torch.empty(o)) for _, o in pairs)

    def initialize(self, generator: torch.Generator, last_gain: float = 1.0) -> None:
        """Weights normal with variance 2/inputs before an activation (He et al. 2015; behind a sine, whose
        variance is ½, it is the same), `last_gain`²/inputs in the last layer; biases 0.

        The papers state no initialization. PyTorch's own (uniform, with random biases) left half of a 25-wide
        layer without a gradient for good at the learning rates used here.
        """
        with torch.no_grad():
            for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
                gain = last_gain if k == len(self.weights) - 1 else math.sqrt(2.0)
                weight.normal_(0.0, gain / math.sqrt(weight.shape[1]), generator=generator)
                bias.zero_()

    @property
    def count(self) -> int:
        """Number of weights, biases included."""
        return sum(p.numel() for p in self.parameters())

    @property
    def last_bias(self) -> Tensor:
        """Biases of the outputs."""
        return self.biases[-1]

    def export(self) -> dict[str, Tensor]:
        """``0.weight`` (outputs, inputs), ``0.bias`` (outputs,), ``1.weight``, …"""
        layers = enumerate(zip(self.weights, self.biases, strict=True))
        return {
            f"{k}.{kind}": p.detach().clone()
            for k, layer in layers
            for kind, p in zip(("weight", "bias"), layer, strict=True)
        }

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Load tensors of :meth:`export`; other entries are ignored."""
        with torch.no_grad():
            for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
                weight.copy_(tensors[f"{k}.weight"])
                bias.copy_(tensors[f"{k}.bias"])

    def forward(self, x: Tensor) -> Tensor:
        """(n, inputs) → (n, outputs); differentiable once."""
        if self.activation != "relu":
            return self.reference(x)
        parameters = [p for pair in zip(self.weights, self.biases, strict=True) for p in pair]
        out: Tensor = _FusedMlp.apply(x, *parameters)
        return out

    def reference(self, x: Tensor) -> Tensor:
        """The same network in plain PyTorch."""
        last = len(self.weights) - 1
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = nn.functional.linear(x, weight, bias)
            x = x if k == last else ACTIVATIONS[self.activation](x)
        return x

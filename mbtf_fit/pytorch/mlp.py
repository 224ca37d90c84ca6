"""Small fully connected networks, row-major (queries, features)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, Literal

import torch
from torch import Tensor, nn

from mbtf_fit.ops.constants import LEAK

Activation = Literal["relu", "leaky-relu", "sine"]
ACTIVATIONS: dict[Activation, Callable[[Tensor], Tensor]] = {
    "relu": torch.relu,
    "leaky-relu": lambda x: nn.functional.leaky_relu(x, LEAK),
    "sine": torch.sin,
}


def initialize_layers(network: nn.Module, generator: torch.Generator) -> None:
    """Weights normal with variance 2/inputs before an activation (He et al. 2015; behind a sine, whose
    variance is ½, it is the same), 1/inputs in the last layer; biases 0.

    The papers state no initialization. PyTorch's own (uniform, with random biases) left half of a 25-wide
    layer without a gradient for good at the learning rates used here.
    """
    *hidden, last = (m for m in network.modules() if isinstance(m, nn.Linear | nn.Conv2d))
    with torch.no_grad():
        for layer in (*hidden, last):
            gain = 1.0 if layer is last else math.sqrt(2.0)
            weight, bias = layer.parameters()
            weight.normal_(0.0, gain / math.sqrt(weight[0].numel()), generator=generator)
            bias.zero_()


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
            if ctx.needs_input_grad[1 + 2 * k]:
                by_parameter[2 * k] = g.t() @ inputs[k]
                by_parameter[2 * k + 1] = ones @ g
            if k == 0 and not ctx.needs_input_grad[0]:
                return None, *by_parameter
            g = g @ weights[k]
            if k:
                torch.ops.aten.threshold_backward.grad_input(g, inputs[k], 0, grad_input=g)
        return g, *by_parameter


class Mlp(nn.Sequential):
    """Fully connected network with an activation between its layers and none after the last.

    Parameters
    ----------
    widths : features of the input, of each hidden layer, and of the output
    """

    def __init__(self, widths: Sequence[int], activation: Activation = "relu") -> None:
        super().__init__(*(nn.Linear(i, o) for i, o in pairwise(widths)))
        self.activation: Activation = activation

    @property
    def weights(self) -> list[nn.Parameter]:
        """Matrix (outputs, inputs) of each layer."""
        return [*self.parameters()][::2]

    def forward(self, x: Tensor) -> Tensor:
        """(n, inputs) → (n, outputs); differentiable once."""
        if self.activation != "relu":
            return self.reference(x)
        out: Tensor = _FusedMlp.apply(x, *self.parameters())
        return out

    def reference(self, x: Tensor) -> Tensor:
        """The same network in plain PyTorch."""
        *hidden, last = self
        for layer in hidden:
            x = ACTIVATIONS[self.activation](layer(x))
        x = last(x)
        return x

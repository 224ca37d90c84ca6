"""Networks: fully connected ones, the inception decoder, and encoders of angular slices.

The inception decoder reads a neighborhood: 1×1 convolution, Inception modules, 1×1 convolution (Xue, Zhao,
Jensen, Montazeri: *A Hierarchical Architecture for Neural Materials*, Computer Graphics Forum 2024). An
Inception module (Szegedy et al., CVPR 2015) joins four branches: 1×1; 1×1 then 3×3; 1×1 then 5×5; 3×3 maximum
then 1×1. Arrays are (items, rows, columns, channels); every module crops two rows and columns at each border;
there is no padding.

The encoders train the models of Rainer et al. (:mod:`mbtf_fit.models.rainer`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, linear, max_pool2d

from mbtf_fit.ops.constants import LEAK
from mbtf_fit.ops.network import Activation

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


class Convolution(nn.Conv2d):
    """A convolution of arrays (items, rows, columns, inputs) without padding."""

    bias: Tensor

    @property
    def matrix(self) -> Tensor:
        """(outputs, inputs) of a 1×1 convolution."""
        return self.weight[:, :, 0, 0]

    def forward(self, x: Tensor) -> Tensor:
        """(items, rows, columns, inputs) → (items, rows-size+1, columns-size+1, outputs)."""
        if self.kernel_size == (1, 1):
            return linear(x, self.matrix, self.bias)
        return conv2d(x.permute(0, 3, 1, 2), self.weight, self.bias).permute(0, 2, 3, 1)


class InceptionModule(nn.Module):
    """One module, `width` → `width` channels.

    The branches have 7 (1×1), 3 then 12 (3×3), 5 then 3 (5×5) and 3 (maximum) of the paper's 25 channels, and
    in proportion for other widths.
    """

    def __init__(self, width: int, activation: Activation) -> None:
        super().__init__()
        self.activate = ACTIVATIONS[activation]
        one, before3, three, before5, five = (max(1, round(width * n / 25)) for n in (7, 3, 12, 5, 3))
        self.one = Convolution(width, one, 1)
        self.before3, self.three = Convolution(width, before3, 1), Convolution(before3, three, 3)
        self.before5, self.five = Convolution(width, before5, 1), Convolution(before5, five, 5)
        self.pooled = Convolution(width, width - one - three - five, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(items, rows, columns, width) → (items, rows-4, columns-4, width)."""
        first = (self.before5, self.before3, self.one)
        # The three that read the same input, as one product.
        weight, bias = torch.cat([c.matrix for c in first]), torch.cat([c.bias for c in first])
        reduced = self.activate(linear(x, weight, bias))
        five, three, one = reduced.split([len(c.bias) for c in first], -1)
        largest = max_pool2d(x[:, 1:-1, 1:-1].permute(0, 3, 1, 2), 3, 1).permute(0, 2, 3, 1)
        outer = [self.three(three[:, 1:-1, 1:-1]), self.five(five), self.pooled(largest)]
        return torch.cat([one[:, 2:-2, 2:-2], self.activate(torch.cat(outer, -1))], -1)


class InceptionDecoder(nn.Module):
    """1×1 convolution, `modules` Inception modules, 1×1 convolution, an activation after all but the last.

    Parameters
    ----------
    features, directions : inputs per sample, and inputs that all samples of an item share
    width : channels between
    modules : how many; each extends the receptive field by 2 samples
    outputs : channels per sample
    """

    def __init__(
        self, features: int, directions: int, width: int, modules: int, outputs: int, activation: Activation
    ) -> None:
        super().__init__()
        self.features = features
        self.activation: Activation = activation
        self.first = Convolution(features + directions, width, 1)
        self.modules_ = nn.ModuleList(InceptionModule(width, activation) for _ in range(modules))
        self.last = Convolution(width, outputs, 1)

    def forward(self, x: Tensor, directions: Tensor) -> Tensor:
        """Features (items, rows, columns, f) and inputs shared by an item (items, d) →
        (items, rows-4·modules, columns-4·modules, outputs)."""
        matrix = self.first.matrix
        shared = linear(directions, matrix[:, self.features :], self.first.bias)
        activate = ACTIVATIONS[self.activation]
        x = activate(linear(x, matrix[:, : self.features]) + shared[:, None, None])
        for module in self.modules_:
            x = module(x)
        out: Tensor = self.last(x)
        return out


class SliceEncoder(nn.Module):
    """Encoder of whole slices at fixed directions: normalized values (items, D, 3) → latents (items, k).

    Parameters
    ----------
    pairs : D
    width : units of both hidden layers
    latents : k
    """

    def __init__(self, pairs: int, width: int, latents: int) -> None:
        super().__init__()
        self.network = Mlp([3 * pairs, width, width, latents])

    def forward(self, values: Tensor, pairs: Tensor) -> Tensor:
        """Latents; `pairs`, the directions (D, 4), are the same for all slices and are not read."""
        out: Tensor = self.network(values.flatten(1))
        return out


class SetEncoder(nn.Module):
    """Encoder of any number of samples: of each, with its directions; their mean; the latents from it.

    Parameters
    ----------
    width : units of the hidden layers
    latents : per texel
    """

    def __init__(self, width: int, latents: int) -> None:
        super().__init__()
        self.each = Mlp([3 + 4, width, width])
        self.joined = Mlp([width, width, latents])

    def forward(self, values: Tensor, pairs: Tensor) -> Tensor:
        """Latents (items, k) of normalized values (items, D, 3) at directions (D, 4)."""
        items, count, _ = values.shape
        samples = torch.cat([values, pairs.expand(items, -1, -1)], 2).flatten(0, 1)
        found: Tensor = self.joined(self.each(samples).view(items, count, -1).mean(1))
        return found

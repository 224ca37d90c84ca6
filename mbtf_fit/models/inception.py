"""The inception decoder, which reads a neighborhood: 1×1 convolution, Inception modules, 1×1 convolution.

Xue, Zhao, Jensen, Montazeri: *A Hierarchical Architecture for Neural Materials*, Computer Graphics Forum
2024. An Inception module (Szegedy et al., CVPR 2015) joins four branches: 1×1; 1×1 then 3×3; 1×1 then 5×5;
3×3 maximum then 1×1. Arrays are (items, rows, columns, channels); every module crops two rows and columns
at each border; there is no padding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, linear, max_pool2d

from mbtf_fit.models.mlp import ACTIVATIONS, Activation

# Rows and columns that an Inception module crops at each border.
REACH = 2


class Convolution(nn.Module):
    """Parameters of a convolution: `weight` (outputs, inputs, size, size) and `bias` (outputs,)."""

    def __init__(self, inputs: int, outputs: int, size: int = 1) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(outputs, inputs, size, size))
        self.bias = nn.Parameter(torch.empty(outputs))

    def initialize(self, generator: torch.Generator, gain: float) -> None:
        """Weights normal with variance gain²/inputs, biases 0."""
        with torch.no_grad():
            self.weight.normal_(0.0, gain / math.sqrt(self.weight[0].numel()), generator=generator)
            self.bias.zero_()

    @property
    def matrix(self) -> Tensor:
        """(outputs, inputs) of a 1×1 convolution."""
        return self.weight[:, :, 0, 0]

    def forward(self, x: Tensor) -> Tensor:
        """(items, rows, columns, inputs) → (items, rows-size+1, columns-size+1, outputs)."""
        if self.weight.shape[-1] == 1:
            return linear(x, self.matrix, self.bias)
        return conv2d(x.permute(0, 3, 1, 2), self.weight, self.bias).permute(0, 2, 3, 1)


def branch_widths(width: int) -> tuple[int, int, int, int, int, int]:
    """(1×1, before 3×3, 3×3, before 5×5, 5×5, behind the maximum): 7, 3, 12, 5, 3, 3 of the paper's 25, and
    in proportion for other widths."""
    share = [max(1, round(width * n / 25)) for n in (7, 3, 12, 5, 3)]
    return share[0], share[1], share[2], share[3], share[4], width - share[0] - share[2] - share[4]


class Inception(nn.Module):
    """One module, `width` → `width` channels."""

    def __init__(self, width: int, activation: Activation) -> None:
        super().__init__()
        self.activate = ACTIVATIONS[activation]
        one, before3, three, before5, five, pooled = branch_widths(width)
        self.one = Convolution(width, one)
        self.before3, self.three = Convolution(width, before3), Convolution(before3, three, 3)
        self.before5, self.five = Convolution(width, before5), Convolution(before5, five, 5)
        self.pooled = Convolution(width, pooled)

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
        self.first = Convolution(features + directions, width)
        self.modules_ = nn.ModuleList(Inception(width, activation) for _ in range(modules))
        self.last = Convolution(width, outputs)

    def initialize(self, generator: torch.Generator) -> None:
        """Variance 2/inputs before an activation, 1/inputs in the last layer; biases 0."""
        for module in self.modules():
            if isinstance(module, Convolution):
                module.initialize(generator, 1.0 if module is self.last else math.sqrt(2.0))

    @property
    def margin(self) -> int:
        """Radius of the receptive field, in samples."""
        return REACH * len(self.modules_)

    @property
    def last_bias(self) -> Tensor:
        """Biases of the outputs."""
        return self.last.bias

    @property
    def count(self) -> int:
        """Number of weights, biases included."""
        return sum(p.numel() for p in self.parameters())

    def forward(self, x: Tensor, directions: Tensor) -> Tensor:
        """Features (items, rows, columns, f) and inputs shared by an item (items, d) → (items, rows-2·margin,
        columns-2·margin, outputs)."""
        matrix = self.first.matrix
        shared = linear(directions, matrix[:, self.features :], self.first.bias)
        activate = ACTIVATIONS[self.activation]
        x = activate(linear(x, matrix[:, : self.features]) + shared[:, None, None])
        for module in self.modules_:
            x = module(x)
        out: Tensor = self.last(x)
        return out

    def _layers(self) -> dict[str, Convolution]:
        named = {name.replace("modules_.", ""): m for name, m in self.named_modules()}
        return {name: m for name, m in named.items() if isinstance(m, Convolution)}

    def export(self) -> dict[str, Tensor]:
        """``first.weight`` (outputs, inputs, 1, 1), ``first.bias``, ``0.one.weight``, …, ``last.bias``."""
        return {
            f"{name}.{kind}": p.detach().clone()
            for name, layer in self._layers().items()
            for kind, p in (("weight", layer.weight), ("bias", layer.bias))
        }

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Load tensors of :meth:`export`; other entries are ignored."""
        with torch.no_grad():
            for name, layer in self._layers().items():
                layer.weight.copy_(tensors[f"{name}.weight"])
                layer.bias.copy_(tensors[f"{name}.bias"])

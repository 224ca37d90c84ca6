"""The inception decoder, which reads a neighborhood: 1×1 convolution, Inception modules, 1×1 convolution.

Xue, Zhao, Jensen, Montazeri: *A Hierarchical Architecture for Neural Materials*, Computer Graphics Forum
2024. An Inception module (Szegedy et al., CVPR 2015) joins four branches: 1×1; 1×1 then 3×3; 1×1 then 5×5;
3×3 maximum then 1×1. Arrays are (items, rows, columns, channels); every module crops two rows and columns
at each border; there is no padding.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, linear, max_pool2d

from mbtf_fit.pytorch.mlp import ACTIVATIONS, Activation

# Rows and columns that an Inception module crops at each border.
REACH = 2


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

    @property
    def margin(self) -> int:
        """Radius of the receptive field, in samples."""
        return REACH * len(self.modules_)

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

"""Networks: fully connected ones, and Inception modules over a neighborhood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from mbtf_fit.ops.operation import NetworkName, Operation, Values

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
    (Xue et al. 2024; Szegedy et al., CVPR 2015), an activation after all convolutions but the last; the
    output is that of the middle.

    A module joins ``one(x)``, ``three(before3(x))``, ``five(before5(x))`` and ``pooled(3×3 maximum of x)``;
    there is no padding. Tensors: ``weights.first.weight`` (outputs, inputs, 1, 1), ``weights.0.one.weight``,
    …, ``weights.last.bias``.

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

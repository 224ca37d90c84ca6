"""Encoders of angular slices, which train the models of Rainer et al. (:mod:`mbtf_fit.models.rainer`)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mbtf_fit.pytorch.mlp import Mlp, initialize_layers


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

    def initialize(self, generator: torch.Generator) -> None:
        """Initialize all parameters at random."""
        initialize_layers(self.network, generator)

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

    def initialize(self, generator: torch.Generator) -> None:
        """Initialize all parameters at random."""
        initialize_layers(self.each, generator)
        initialize_layers(self.joined, generator)

    def forward(self, values: Tensor, pairs: Tensor) -> Tensor:
        """Latents (items, k) of normalized values (items, D, 3) at directions (D, 4)."""
        items, count, _ = values.shape
        samples = torch.cat([values, pairs.expand(items, -1, -1)], 2).flatten(0, 1)
        found: Tensor = self.joined(self.each(samples).view(items, count, -1).mean(1))
        return found

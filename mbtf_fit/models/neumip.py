"""NeuMIP: Multi-Resolution Neural Materials.

Kuznetsov, Mullia, Xu, Hašan, Ramamoorthi: ACM Transactions on Graphics 40(4), article 175, 2021. A pyramid of
learned textures is read at the query's footprint; a small network decodes the features, together with
light and view direction, into colour. A second texture and network move the lookup along the view
direction, which gives parallax (the *neural offset*).

Where this differs from the paper:

- Levels are blended with ``1 - frac(l)`` and ``frac(l)``; the printed weights both vanish at whole levels.
- The decoder has the 3 outputs of the paper's text. Its weight count of 3332 is that of 6 outputs (in the
  published code: YUV and a gate; ``network.outputs: 6``); with 3 it is 3254.
- No final ReLU in training: a unit below zero would never recover. Materials clamp at inference.
- Values are ``unit · (exp(x) - 1)`` with the data's mean as the unit, so that materials of any brightness are
  learned alike; the paper's unit is 1.
- The network's answer r is scaled by 0.1 and the offset texture starts at zero, as in the published code.
- The tile may be non-square, r is a length in tile widths: the v-component is divided by the aspect.
- Directions outside the upper hemisphere are not defined; the caller keeps to z > 0.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from mbtf_gen.schema import Layout

from .mlp import Mlp
from .textured import TexturedMaterial


class Neumip(TexturedMaterial):
    """NeuMIP with the neural offset.

    ``u' = u + r / max(ω_o,z, 0.6) · ω_o,xy`` with ``r = F_off(T_off(u), ω_o,xy)``; T_off is one texture of
    the finest level.
    """

    name = "neumip"
    layout: ClassVar[Layout] = "shuffled"

    def _make_decoder(self, features: int, directions: int) -> Mlp:
        network = self.network
        hidden = [network.width] * (network.layers - 1)
        return Mlp([features + directions, *hidden, network.outputs], network.activation)

    def stage1(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> Tensor:
        return self.features(u, sigma, omega_o)

    def stage2(self, features: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        return self.to_value(self.decoder(torch.cat([features, self.directions(omega_i, omega_o)], 1)))


class NeumipBaseline(Neumip):
    """NeuMIP without the neural offset."""

    name = "neumip-baseline"

"""NeuMIP: Multi-Resolution Neural Materials.

Kuznetsov, Mullia, Xu, Hašan, Ramamoorthi: ACM Transactions on Graphics 40(4), article 175, 2021. A pyramid of
learned textures is read at the query's footprint; a small network decodes the features, together with
light and view direction, into colour. A second texture and network move the lookup along the view
direction, which gives parallax (the *neural offset*).

Where this differs from the paper:

- Levels are blended with ``1 - frac(l)`` and ``frac(l)``; the printed weights both vanish at whole levels.
- The decoder has the 3 outputs of the paper's text. Its weight count of 3332 is that of 6 outputs (in the
  published code: YUV and a gate); with 3 it is 3254.
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
from torch import Tensor, nn

from mbtf_gen.levels import Lattice
from mbtf_gen.schema import Layout

from .interface import NeuralMaterial
from .mlp import Mlp
from .textures import FeatureTextures

# Standard deviation of the features that training starts from.
FEATURE_SCALE = 0.1
# Tile widths per unit that the offset network answers.
OFFSET_SCALE = 0.1
# Cosine below which the offset grows no further towards grazing views.
GRAZING = 0.6


class NeumipBaseline(NeuralMaterial):
    """NeuMIP without the neural offset.

    Parameters
    ----------
    lattice : texel grids of the tile
    channels : features per texel
    width, layers : of the decoder: features of its hidden layers, number of its layers
    """

    name = "neumip-baseline"
    layout: ClassVar[Layout] = "shuffled"

    def __init__(self, lattice: Lattice, *, channels: int = 7, width: int = 25, layers: int = 4) -> None:
        super().__init__(lattice)
        self.pyramid = FeatureTextures(lattice, range(lattice.finest + 1), channels)
        self.decoder = Mlp([channels + 4, *[width] * (layers - 1), 3])
        self.unit: Tensor
        self.register_buffer("unit", torch.ones(()))

    def initialise(self, generator: torch.Generator, unit: float) -> None:
        nn.init.normal_(self.pyramid.texels, std=FEATURE_SCALE, generator=generator)
        self.decoder.initialise(generator)
        self.unit.fill_(unit)

    def formula(self) -> dict[str, str]:
        return {
            "features": "the textures pyramid.0 ... pyramid.k (level 0 to k) at u, blended by level",
            "x": "decoder(features, omega_i.x, omega_i.y, omega_o.x, omega_o.y)",
            "value": "unit * (exp(x) - 1)",
        }

    def stage1(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> Tensor:
        features: Tensor = self.pyramid(u, self.level(sigma))
        return features

    def stage2(self, features: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        x = self.decoder(torch.cat([features, omega_i[:, :2], omega_o[:, :2]], 1))
        return self.unit * torch.expm1(x)


class Neumip(NeumipBaseline):
    """NeuMIP with the neural offset.

    ``u' = u + r / max(ω_o,z, 0.6) · ω_o,xy`` with ``r = F_off(T_off(u), ω_o,xy)``; T_off is one texture of
    the finest level.
    """

    name = "neumip"

    def __init__(self, lattice: Lattice, *, channels: int = 7, width: int = 25, layers: int = 4) -> None:
        super().__init__(lattice, channels=channels, width=width, layers=layers)
        self.offset_texture = FeatureTextures(lattice, [lattice.finest], channels, moves_lookups=True)
        self.offset_network = Mlp([channels + 2, *[width] * (layers - 1), 1])

    def initialise(self, generator: torch.Generator, unit: float) -> None:
        super().initialise(generator, unit)
        nn.init.zeros_(self.offset_texture.texels)
        self.offset_network.initialise(generator)

    def formula(self) -> dict[str, str]:
        return {
            "r": f"{OFFSET_SCALE} * offset_network(texture offset_texture.0 at u, omega_o.x, omega_o.y)",
            "offset": f"r / max(omega_o.z, {GRAZING}) * (omega_o.x, omega_o.y), in tile widths",
            "u'": "u + offset / (1, aspect)",
            **super().formula(),
            "features": "the textures pyramid.0 ... pyramid.k (level 0 to k) at u', blended by level",
        }

    def offset(self, u: Tensor, omega_o: Tensor) -> Tensor:
        seen = torch.cat([self.offset_texture(u), omega_o[:, :2]], 1)
        r = OFFSET_SCALE * self.offset_network(seen)
        return r * (omega_o[:, :2] / omega_o[:, 2:].clamp_min(GRAZING))

    def stage1(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> Tensor:
        moved = u + self.offset(u, omega_o) / u.new_tensor([1.0, self.lattice.aspect])
        return super().stage1(moved, sigma, omega_o)

"""NeuMIP: Multi-Resolution Neural Materials.

Kuznetsov, Mullia, Xu, Hašan, Ramamoorthi: ACM Transactions on Graphics 40(4), article 175, 2021. A pyramid of
learned textures is read at the query's footprint; a small network decodes the features, together with
light and view direction, into color. A second texture and network move the lookup along the view
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

from mbtf_core.errors import InputError
from mbtf_core.lattice import Lattice
from mbtf_core.shard_schema import Layout
from mbtf_fit.config import NetworkSection
from mbtf_fit.models.calibration_factors import look_up_gain
from mbtf_fit.models.mlp import Mlp
from mbtf_fit.models.textured import TexturedMaterial


class Neumip(TexturedMaterial):
    """NeuMIP with the neural offset.

    ``u' = u + r / max(ω_o,z, 0.6) · ω_o,xy`` with ``r = F_off(T_off(u), ω_o,xy)``; T_off is one texture of
    the finest level.

    Attributes
    ----------
    gain : (2, levels, knots, 3) factors by light's and by view's elevation, from
        :mod:`mbtf_fit.training.calibration`; None for a model that was not calibrated
    """

    name = "neumip"
    layout: ClassVar[Layout] = "shuffled"

    def __init__(self, lattice: Lattice, network: NetworkSection) -> None:
        super().__init__(lattice, network)
        self.gain: Tensor | None
        self.register_buffer("gain", None)

    def _make_decoder(self, features: int, directions: int) -> Mlp:
        network = self.network
        hidden = [network.width] * (network.layers - 1)
        return Mlp([features + directions, *hidden, network.outputs], network.activation)

    def stage1(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> Tensor:
        features = self.features(u, sigma, omega_o)
        if self.gain is None:
            return features
        level = self.level(sigma)
        by_view = look_up_gain(self.gain[1], level, omega_o[:, 2])
        return torch.cat([features, by_view, level[:, None]], 1)

    def stage2(self, features: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        directions = self.directions(omega_i, omega_o)
        if self.gain is None:
            return self.to_value(self.decoder(torch.cat([features, directions], 1)))
        features, by_view, level = features.tensor_split([-4, -1], 1)
        value = self.to_value(self.decoder(torch.cat([features, directions], 1)))
        return value * by_view * look_up_gain(self.gain[0], level[:, 0], omega_i[:, 2])

    def gains(self, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """The factors (n, 3) alone; 1 without calibration."""
        if self.gain is None:
            return torch.ones_like(omega_i)
        level = self.level(sigma)
        by_light, by_view = (
            look_up_gain(table, level, omega[:, 2])
            for table, omega in zip(self.gain, (omega_i, omega_o), strict=True)
        )
        return by_light * by_view

    def load_weights(self, tensors: dict[str, Tensor]) -> None:
        name = "gain"
        gain = tensors.get(name)
        if gain is not None:
            # Of any number of knots.
            wanted = (2, self.lattice.finest + 1, gain.shape[2] if gain.ndim == 4 else 0, 3)
            if gain.shape != wanted or wanted[2] < 2:
                raise InputError(f"the weights do not fit the model {self.name}: '{name}'")
        self.gain = None if gain is None else gain.float().clone()
        super().load_weights(tensors)

    def formula(self) -> dict[str, str]:
        out = super().formula()
        if self.gain is None:
            return out
        knots = self.gain.shape[2]
        out["gain"] = (
            f"G_i * G_o, where G_i is gain[0] at the level l and the cosine omega_i.z, G_o gain[1] at l and "
            f"omega_o.z, a factor per color; gain is (2, levels, {knots} knots, 3), the knots stand at the "
            f"cosines 0, 1/{knots - 1}, ..., 1; linear between knots, and between levels as textures are"
        )
        out["value"] = f"gain * {out['value']}"
        return out


class NeumipBaseline(Neumip):
    """NeuMIP without the neural offset."""

    name = "neumip-baseline"

"""NeuMIP: Multi-Resolution Neural Materials.

Kuznetsov, Mullia, Xu, Hašan, Ramamoorthi: ACM Transactions on Graphics 40(4), article 175, 2021. A pyramid of
learned textures is read at the query's footprint; a small network decodes the features, together with
light and view direction, into color. A second texture and network shift the lookup along the view
direction, which reproduces parallax (the *neural offset*).

Deviations from the paper:

- Levels are blended with ``1 - frac(l)`` and ``frac(l)``; the printed weights both vanish at whole levels.
- The decoder has the 3 outputs of the paper's text. Its weight count of 3332 is that of 6 outputs (in the
  published code: YUV and a gate; ``network.output_channels: 6``); with 3 it is 3254.
- No final ReLU in training: the gradient of an output below zero would vanish. Materials clamp at inference.
- Values are ``unit · (exp(x) - 1)`` with the data's mean as the unit, so that training does not depend on the
  brightness of the material; the paper's unit is 1.
- The offset network's output r is scaled by 0.1 and the offset texture starts at zero, as in the published
  code.
- The tile may be non-square, r is a length in tile widths: the v-component is divided by the aspect.
- Directions outside the upper hemisphere are undefined; the caller ensures z > 0.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit.config import NetworkSection
from mbtf_fit.models.interface import NeuralMaterial

# Knots of the cosine in a fitted table: 0, 1/16, ..., 1.
KNOTS = 17


def interpolate_factors(table: Tensor, level: Tensor, cosine: Tensor) -> Tensor:
    """Calibration factors (n, 3) of a table (levels, knots, 3) at fractional levels (n,) and cosines (n,):
    bilinear between levels and knots, which are equidistant in [0, 1]."""
    last = max(1, table.shape[0] - 1)
    # An image whose rows are levels, in the coordinates of grid_sample: corners at -1 and 1.
    position = torch.stack([2.0 * cosine - 1.0, (2.0 / last) * level - 1.0], -1)
    found = torch.nn.functional.grid_sample(
        table.permute(2, 0, 1)[None], position[None, :, None], padding_mode="border", align_corners=True
    )
    return found[0, :, :, 0].T


class Neumip(NeuralMaterial):
    """NeuMIP with the neural offset.

    ``u' = u + r / max(ω_o,z, 0.6) · ω_o,xy`` with ``r = F_off(T_off(u), ω_o,xy)``; T_off is one texture of
    the finest level.

    Attributes
    ----------
    calibration : (2, levels, knots, 3) factors by elevation of light and of view
        (:mod:`mbtf_fit.training.calibration`); None without calibration
    """

    name = "neumip"

    def __init__(self, lattice: Lattice, network: NetworkSection) -> None:
        super().__init__(lattice, network)
        self.calibration: Tensor | None
        self.register_buffer("calibration", None)

    def stage1(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> Tensor:
        features = self.features(u, sigma, omega_o)
        if self.calibration is None:
            return features
        level = self.level(sigma)
        by_view = interpolate_factors(self.calibration[1], level, omega_o[:, 2])
        return torch.cat([features, by_view, level[:, None]], 1)

    def stage2(self, features: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        if self.calibration is None:
            return self.decode(features, omega_i, omega_o)
        features, by_view, level = features.tensor_split([-4, -1], 1)
        value = self.decode(features, omega_i, omega_o)
        return value * by_view * interpolate_factors(self.calibration[0], level[:, 0], omega_i[:, 2])

    def decode(self, features: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Value (n, 3) in 1/sr of :meth:`features`, without calibration."""
        return self.to_value(self.decoder(torch.cat([features, self.directions(omega_i, omega_o)], 1)))

    def calibration_factors(self, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Product (n, 3) of both calibration factors; 1 without calibration."""
        if self.calibration is None:
            return torch.ones_like(omega_i)
        level = self.level(sigma)
        by_light, by_view = (
            interpolate_factors(table, level, omega[:, 2])
            for table, omega in zip(self.calibration, (omega_i, omega_o), strict=True)
        )
        return by_light * by_view

    def load_weights(self, tensors: dict[str, Tensor]) -> None:
        name = "calibration"
        calibration = tensors.get(name)
        if calibration is not None:
            # Of any number of knots.
            shape = (2, self.lattice.finest + 1, calibration.shape[2] if calibration.ndim == 4 else 0, 3)
            if calibration.shape != shape or shape[2] < 2:
                raise InputError(f"the weights do not fit the model {self.name}: '{name}'")
        self.calibration = None if calibration is None else calibration.float().clone()
        super().load_weights(tensors)

    def formula(self) -> dict[str, str]:
        out = super().formula()
        if self.calibration is None:
            return out
        knots = self.calibration.shape[2]
        out["calibration"] = (
            "G_i * G_o, where G_i is calibration[0] at the level l and the cosine omega_i.z, G_o is "
            "calibration[1] at l and omega_o.z, a factor per color; calibration is (2, levels, "
            f"{knots} knots, 3), the knots are the cosines 0, 1/{knots - 1}, ..., 1; linear between knots "
            "and between levels"
        )
        out["value"] = f"calibration * {out['value']}"
        return out


class NeumipBaseline(Neumip):
    """NeuMIP without the neural offset."""

    name = "neumip-baseline"

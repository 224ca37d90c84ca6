"""Real-Time Neural Appearance Models.

Zeltner, Rousselle, Weidlich, Clarberg, Novák, Bitterli, Evans, Davidovič, Kallweit, Lefohn: ACM Transactions
on Graphics 43(3), article 33, 2024. A pyramid of 8 learned channels is read at the query's footprint. One
linear layer turns the features into two shading frames, and a small network decodes the features, and light
and view in each of the frames, into color. Highlights about normals that vary from texel to texel, and along
tangents, are then functions of directions that the network sees in the right frame.

The paper has decoders of two layers of 16 units to three of 64 (`network.width`; `network.layers` counts the
output too).

Deviations from the paper:

- The paper's encoder computes the first textures from the maps of a layered material. Data sets of other
  materials have no such maps: textures are optimized from the start.
- The linear layer starts at frames near the tile's, as the texels start near zero.
- Values are ``unit · exp(x)`` with a robust mean of the data as the unit; losses are those of the
  other models.
- Importance sampling is that of all models, in place of the paper's second network.
- No parallax: the paper models BRDFs, whose features lie at the query.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models.model import PYRAMID, Model
from mbtf_fit.models.neumip import hidden_layers, pyramid
from mbtf_fit.ops import Network, Operation, ToFrame, Transform
from mbtf_fit.sections import NetworkSection

# Shading frames, and numbers that describe each: its normal and tangent.
_FRAMES, _NUMBERS = 2, 6


class Zeltner(Model):
    """A decoder that sees directions in two learned shading frames."""

    name = "zeltner2024"
    description = "directions in two learned shading frames (Zeltner et al. 2024)"
    defaults: ClassVar[Mapping[str, Any]] = {
        "network": {"offset": "none", "channels": 8, "width": 64, "layers": 4, "output_transform": "exp"}
    }
    takes = tuple(name for name in PYRAMID if name not in ("network.output_channels", "network.encoding"))

    @classmethod
    def operations(cls, lattice: Lattice, network: NetworkSection) -> list[Operation]:
        inputs, frames = ["features"], []
        for k in range(_FRAMES):
            axes = f"axes[{_NUMBERS * k}:{_NUMBERS * (k + 1)}]"
            for name, omega in (("light", "omega_i"), ("view", "omega_o")):
                frames.append(ToFrame(f"{name}_{k}", axes, omega))
                inputs.append(f"{name}_{k}")
        return [
            # (Z1) z = P(u, σ), (n_1, t_1, n_2, t_2) = A z + b
            pyramid("u", network),
            Network("axes", ("features",), weights="frames", hidden=(), outputs=_FRAMES * _NUMBERS),
            # (Z2) x = F(z, T_1 ω_i, T_1 ω_o, T_2 ω_i, T_2 ω_o)
            *frames,
            Network(
                "x",
                tuple(inputs),
                weights="decoder",
                hidden=hidden_layers(network),
                outputs=3,
                activation=network.activation,
            ),
            Transform("value", "x", network.output_transform, factor="unit", most="most"),
        ]

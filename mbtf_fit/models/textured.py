"""Common part of all models: a pyramid of learned textures with a neural offset of the lookup."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor, nn

from mbtf_core.lattice import Lattice
from mbtf_fit.config import NetworkSection
from mbtf_fit.models.constants import GRAZING, OFFSET_SCALE, direction_size, position_size
from mbtf_fit.models.encodings import encode_direction, encode_position, encoding_formula
from mbtf_fit.models.inception import InceptionDecoder
from mbtf_fit.models.interface import NeuralMaterial
from mbtf_fit.models.lookup import coarse_level
from mbtf_fit.models.mlp import Mlp
from mbtf_fit.models.outputs import output_formula, start_of, to_value
from mbtf_fit.models.textures import FeatureTextures

# Standard deviation of the initial features.
FEATURE_SCALE = 0.1


class TexturedMaterial(NeuralMaterial):
    """Pyramid, offset and output transform; sub-classes decode the features.

    Parameters
    ----------
    lattice : texel grids of the tile
    network : the architecture
    """

    def __init__(self, lattice: Lattice, network: NetworkSection) -> None:
        super().__init__(lattice, network)
        self.pyramid = FeatureTextures(lattice, range(lattice.finest + 1), network.channels)
        self.decoder = self._make_decoder(
            network.channels * (2 if network.blending == "concatenate" else 1)
            + position_size(network.encoding),
            2 * direction_size(network.encoding),
        )
        self.unit: Tensor
        self.register_buffer("unit", torch.ones(()))
        if network.offset != "none":
            self.offset_texture = FeatureTextures(
                lattice, [lattice.finest], network.channels, moves_lookups=True
            )
            outputs = 1 if network.offset == "depth" else 2
            hidden = [network.width] * (network.layers - 1)
            self.offset_network = Mlp([network.channels + 2, *hidden, outputs], network.activation)

    @abstractmethod
    def _make_decoder(self, features: int, directions: int) -> Mlp | InceptionDecoder:
        """The decoder: inputs are features (encoded position included) and encoded light and view."""

    def initialize(self, generator: torch.Generator, unit: float) -> None:
        nn.init.normal_(self.pyramid.texels, std=FEATURE_SCALE, generator=generator)
        self.decoder.initialize(generator)
        with torch.no_grad():
            start = start_of(self.network.output_transform, self.network.output_channels)
            self.decoder.last_bias.copy_(torch.tensor(start))
        self.unit.fill_(unit)
        if self.network.offset != "none":
            nn.init.zeros_(self.offset_texture.texels)
            self.offset_network.initialize(generator)

    def offset(self, u: Tensor, omega_o: Tensor) -> Tensor:
        if self.network.offset == "none":
            return torch.zeros_like(u)
        inputs = torch.cat([self.offset_texture(u), omega_o[:, :2]], 1)
        r: Tensor = OFFSET_SCALE * self.offset_network(inputs)
        if self.network.offset == "direct":
            return r
        return r * (omega_o[:, :2] / omega_o[:, 2:].clamp_min(GRAZING))

    def read(self, u: Tensor, level: Tensor) -> Tensor:
        """Features of the pyramid at `u` (n, 2) and fractional levels (n,), without offset: (n, f)."""
        features: Tensor
        if self.network.blending == "blend":
            features = self.pyramid(u, level)
            return features
        coarse, weight = coarse_level(level, self.lattice.finest + 1)
        low = (1 - weight)[:, None] * self.pyramid(u, coarse)
        high = weight[:, None] * self.pyramid(u, coarse + 1)
        # Even and odd levels keep their order, so that the result is continuous at whole levels.
        odd = (coarse.remainder(2) == 1)[:, None]
        return torch.cat([torch.where(odd, high, low), torch.where(odd, low, high)], 1)

    def features(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> Tensor:
        """Inputs (n, f) of the decoder at single positions `u` (n, 2), footprints (n,) and views (n, 3)."""
        moved = u
        if self.network.offset != "none":
            moved = u + self.offset(u, omega_o) / u.new_tensor([1.0, self.lattice.aspect])
        level = self.level(sigma)
        features = self.read(moved, level)
        if self.network.encoding.position == 0:
            return features
        encoded = encode_position(u, level, self.lattice.aspect, self.network.encoding)
        return torch.cat([features, encoded], 1)

    def directions(self, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Inputs (n, d) of the decoder for light and view (n, 3)."""
        options = self.network.encoding
        return torch.cat([encode_direction(omega_i, options), encode_direction(omega_o, options)], 1)

    def to_value(self, x: Tensor) -> Tensor:
        """Values (..., 3) in 1/sr of the decoder's outputs."""
        return to_value(x, self.unit, self.network.output_transform)

    def formula(self) -> dict[str, str]:
        network, encoding = self.network, self.network.encoding
        omega = "(x, y, z)" if encoding.direction_xyz else "(x, y)"
        r = "offset_network(texture offset_texture.0 at u, omega_o.x, omega_o.y)"
        out: dict[str, str] = {}
        if network.offset == "depth":
            out["r"] = f"{OFFSET_SCALE} * {r}"
            out["offset"] = f"r / max(omega_o.z, {GRAZING}) * (omega_o.x, omega_o.y), in tile widths"
        elif network.offset == "direct":
            out["offset"] = f"{OFFSET_SCALE} * {r}, in tile widths"
        position = "u"
        if out:
            out["u'"] = "u + offset / (1, aspect)"
            position = "u'"
        textures = f"the textures pyramid.0 ... pyramid.k (level 0 to k) at {position}"
        if network.blending == "blend":
            out["features"] = f"{textures}, blended by level"
        else:
            out["features"] = (
                f"{textures}, of the two adjacent levels, each times its weight: first the even level, "
                "then the odd level"
            )
        if encoding.position:
            spread = "; s = 2^-level / (1, aspect)" if encoding.footprint_filtered else ""
            p = encoding_formula("p = 2 (u mod 1) - 1", encoding.position, encoding.pi, encoding, spread)
            out["features"] += f"; then the position u encoded: {p}"
        out["light, view"] = encoding_formula(
            f"{omega} of omega_i, of omega_o", encoding.direction, encoding.direction_pi, encoding
        )
        out["x"] = "decoder(features, light, view)"
        out["value"] = output_formula(network.output_transform, network.output_channels)
        return out

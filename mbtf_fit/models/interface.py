"""Neural materials: a pyramid of learned textures with a neural offset of the lookup, and a decoder."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor, nn

from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import Layout
from mbtf_core.errors import InputError
from mbtf_fit.config import NetworkSection
from mbtf_fit.models.constants import GRAZING, OFFSET_SCALE, directions_size, position_size
from mbtf_fit.models.encodings import (
    directions_formula,
    encode_directions,
    encode_position,
    encoding_formula,
)
from mbtf_fit.models.inception import InceptionDecoder
from mbtf_fit.models.lookup import coarse_level
from mbtf_fit.models.mlp import Mlp, initialize_layers
from mbtf_fit.models.outputs import output_formula, start_of, to_value
from mbtf_fit.models.textures import FeatureTextures

# Standard deviation of the initial features.
FEATURE_SCALE = 0.1


class NeuralMaterial(nn.Module, ABC):
    """A model of ``M(u, σ, ω_i, ω_o)`` in two stages, a function of each query alone.

    Stage 1 does not depend on the light; stage 2 is evaluated once per light.

    Parameters
    ----------
    lattice : texel grids of the tile
    network : the architecture

    Attributes
    ----------
    name : in configurations and materials
    layout : of the shards that it is trained on
    """

    name: ClassVar[str]
    layout: ClassVar[Layout] = "shuffled"
    unit: Tensor

    def __init__(self, lattice: Lattice, network: NetworkSection) -> None:
        super().__init__()
        self.lattice = lattice
        self.network = network
        finer = network.oversampling.bit_length() - 1
        grids = Lattice(lattice.finest + finer, lattice.aspect)
        channels = self.texture_channels(network)
        self.pyramid = FeatureTextures(grids, range(finer, grids.finest + 1), channels)
        features = network.channels * (2 if network.blending == "concatenate" else 1)
        features += position_size(network.encoding)
        directions = directions_size(network.encoding) + self.hint_size(network)
        hidden = [network.width] * (network.layers - 1)
        self.decoder: Mlp | InceptionDecoder
        if network.decoder == "mlp":
            outputs = network.output_channels + self.gate_size(network)
            self.decoder = Mlp([features + directions, *hidden, outputs], network.activation)
        else:
            sizes = network.width, network.layers - 2, network.output_channels
            self.decoder = InceptionDecoder(features, directions, *sizes, network.activation)
        self.register_buffer("unit", torch.ones(()))
        if network.offset != "none":
            self.offset_texture = FeatureTextures(
                lattice, [lattice.finest], network.channels, moves_lookups=True
            )
            outputs = 1 if network.offset == "depth" else 2
            self.offset_network = Mlp([network.channels + 2, *hidden, outputs], network.activation)

    @classmethod
    def texture_channels(cls, network: NetworkSection) -> int:
        """Channels of the pyramid."""
        return network.channels

    @classmethod
    def hint_size(cls, network: NetworkSection) -> int:
        """Inputs of the decoder besides features and directions."""
        return 0

    @classmethod
    def gate_size(cls, network: NetworkSection) -> int:
        """Outputs of the decoder besides those of the value."""
        return 0

    @property
    def margin(self) -> int:
        """Radius of the neighborhood that the value depends on, in texels of the nearest level."""
        return self.decoder.margin if isinstance(self.decoder, InceptionDecoder) else 0

    @property
    def positions(self) -> int:
        """Positions at which stage 1 reads the textures for one query."""
        return (2 * self.margin + 1) ** 2

    def initialize(self, generator: torch.Generator, unit: float) -> None:
        """Initialize all parameters at random.

        `unit` is a typical value of the data in 1/sr. Values are multiples of it, so that black data (0) are
        fitted exactly.
        """
        nn.init.normal_(self.pyramid.texels, std=FEATURE_SCALE, generator=generator)
        initialize_layers(self.decoder, generator)
        *_, last_bias = self.decoder.parameters()
        start = start_of(self.network.output_transform, self.network.output_channels)
        last_bias.data[: len(start)] = torch.tensor(start)
        self.unit.fill_(unit)
        if self.network.offset != "none":
            nn.init.zeros_(self.offset_texture.texels)
            initialize_layers(self.offset_network, generator)

    @abstractmethod
    def stage1(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> Tensor:
        """Features (n, ...) at uv positions `u` (n, 2), footprints `sigma` (n,) in tile widths and views
        `omega_o` (n, 3)."""

    @abstractmethod
    def stage2(self, features: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Value (n, 3) in 1/sr for light from `omega_i` (n, 3). Not clamped: it may be negative."""

    def forward(self, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Both stages: value (n, 3) in 1/sr."""
        return self.stage2(self.stage1(u, sigma, omega_o), omega_i, omega_o)

    def level(self, sigma: Tensor) -> Tensor:
        """Fractional level ``-log2(2σ)`` of footprints, clamped to the lattice's levels."""
        return -torch.log2(2.0 * sigma).clamp(-float(self.lattice.finest), 0.0)

    def offset(self, u: Tensor, omega_o: Tensor) -> Tensor:
        """Neural offset of the lookup, (n, 2) in tile widths; zero for a model without offset."""
        if self.network.offset == "none":
            return torch.zeros_like(u)
        inputs = torch.cat([self.offset_texture(u), omega_o[:, :2]], 1)
        r: Tensor = OFFSET_SCALE * self.offset_network(inputs)
        if self.network.offset == "direct":
            return r
        return r * (omega_o[:, :2] / omega_o[:, 2:].clamp_min(GRAZING))

    def read(self, u: Tensor, level: Tensor) -> Tensor:
        """Features of the pyramid at `u` (n, 2) and fractional levels (n,), without offset: (n, f)."""
        if self.network.blending == "blend":
            features: Tensor = self.pyramid(u, level)
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
        return encode_directions(omega_i, omega_o, self.network.encoding)

    def to_value(self, x: Tensor) -> Tensor:
        """Values (..., 3) in 1/sr of the decoder's outputs."""
        return to_value(x, self.unit, self.network.output_transform)

    def textures(self) -> list[FeatureTextures]:
        """The model's learned textures: the pyramid, then the offset's."""
        return [module for module in self.children() if isinstance(module, FeatureTextures)]

    def stored_textures(self) -> dict[str, FeatureTextures]:
        """Textures that a material stores, by name."""
        return {n: module for n, module in self.named_children() if isinstance(module, FeatureTextures)}

    def parameter_groups(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        """(texels, network weights)."""
        return [texture.texels for texture in self.textures()], [*self._layers().values()]

    def trained(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        """(texels, network weights) that training changes."""
        texels, weights = self.parameter_groups()
        return texels, [p for p in weights if p.requires_grad]

    def networks(self) -> dict[str, nn.Module]:
        """Networks that do not depend on the material, by name: materials can share them."""
        names = ("decoder", "offset_network")
        return {name: module for name, module in self.named_children() if name in names}

    def share_networks(self, other: NeuralMaterial) -> None:
        """Use the networks of another model of the same architecture in place of its own ones."""
        for name, module in other.networks().items():
            setattr(self, name, module)

    def freeze(self) -> None:
        """Exclude the networks from training."""
        for module in self.networks().values():
            module.requires_grad_(False)

    @property
    def frozen(self) -> bool:
        """Whether the networks are excluded from training."""
        return not any(p.requires_grad for module in self.networks().values() for p in module.parameters())

    def _layers(self) -> dict[str, nn.Parameter]:
        """Network weights by their names in a material."""
        return {
            name.replace("modules_.", ""): p
            for name, p in self.named_parameters()
            if not name.endswith(".texels")
        }

    def weights(self) -> dict[str, Tensor]:
        """All tensors of the model by name, with the current blur: one tensor (rows, columns, channels) per
        level of a texture; network layers as ``NAME.0.weight`` (outputs, inputs) and ``NAME.0.bias``,
        convolutions as ``NAME.weight`` (outputs, inputs, rows, columns)."""
        textures = {
            f"{name}.{level}": tensor
            for name, module in self.stored_textures().items()
            for level, tensor in module.export().items()
        }
        others = {**dict(self.named_buffers()), **self._layers()}
        return textures | {name: tensor.detach().clone() for name, tensor in others.items()}

    def load_weights(self, tensors: dict[str, Tensor]) -> None:
        """Load tensors of :meth:`weights`."""
        mine = self.weights()
        for name in sorted({*mine, *tensors}):
            if name not in tensors or name not in mine or tensors[name].shape != mine[name].shape:
                raise InputError(f"the weights do not fit the model {self.name}: '{name}'")
        with torch.no_grad():
            for name, tensor in (*self.named_buffers(), *self._layers().items()):
                tensor.copy_(tensors[name])
            for name, module in self.stored_textures().items():
                module.load({k.removeprefix(f"{name}."): t for k, t in tensors.items()})

    def formula(self) -> dict[str, str]:
        """Formulas of the value in terms of :meth:`weights`, as text for an export."""
        network, encoding = self.network, self.network.encoding
        r = f"{OFFSET_SCALE} * offset_network(texture offset_texture.0 at u, omega_o.x, omega_o.y)"
        out: dict[str, str] = {}
        if network.offset == "depth":
            out["r"] = r
            out["offset"] = f"r / max(omega_o.z, {GRAZING}) * (omega_o.x, omega_o.y), in tile widths"
        elif network.offset == "direct":
            out["offset"] = f"{r}, in tile widths"
        position = "u"
        if out:
            position = "u'"
            out[position] = "u + offset / (1, aspect)"
        how = "blended by level"
        if network.blending == "concatenate":
            how = (
                "of the two adjacent levels, each times its weight: first the even level, then the odd level"
            )
        features = f"the textures pyramid.0 ... pyramid.k (level 0 to k) at {position}, {how}"
        if encoding.position:
            spread = "; s = 2^-level / (1, aspect)" if encoding.footprint_filtered else ""
            p = encoding_formula("p = 2 (u mod 1) - 1", encoding.position, encoding.pi, encoding, spread)
            features += f"; then the position u encoded: {p}"
        return {
            **out,
            "features": features,
            "light, view": directions_formula(encoding),
            "x": "decoder(features, light, view)",
            "value": output_formula(network.output_transform, network.output_channels),
        }

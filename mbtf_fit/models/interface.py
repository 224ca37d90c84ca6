"""What the trainer, the exporter and the renderers know of a model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor, nn

from mbtf_core.errors import InputError
from mbtf_core.lattice import Lattice
from mbtf_core.shard_schema import Layout
from mbtf_fit.config import NetworkSection
from mbtf_fit.models.inception import InceptionDecoder
from mbtf_fit.models.mlp import Mlp
from mbtf_fit.models.textures import FeatureTextures

# Modules that give and take their numbers by name.
_PARTS = (FeatureTextures, Mlp, InceptionDecoder)


class NeuralMaterial(nn.Module, ABC):
    """A model of ``M(u, σ, ω_i, ω_o)`` in two stages, a function of each query alone.

    Stage 1 depends on the view alone and is shared by all lights; stage 2 is evaluated once per light.

    Attributes
    ----------
    name : by which configurations and materials call the model
    layout : layout of the shards that it is trained on
    lattice : texel grids of the tile
    network : its architecture
    """

    name: ClassVar[str]
    layout: ClassVar[Layout]

    def __init__(self, lattice: Lattice, network: NetworkSection) -> None:
        super().__init__()
        self.lattice = lattice
        self.network = network

    @property
    def margin(self) -> int:
        """Places on each side of a query that the value depends on, one texel of the nearest level apart."""
        return 0

    @property
    def positions(self) -> int:
        """Places at which stage 1 reads the textures for one query."""
        return (2 * self.margin + 1) ** 2

    @abstractmethod
    def initialize(self, generator: torch.Generator, unit: float) -> None:
        """Draw all parameters anew; `unit` is the typical value of the data in 1/sr, 0
        for black data: values are multiples of it, so that black is fitted exactly."""

    @abstractmethod
    def stage1(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> Tensor:
        """Features (n, ...) at uv positions `u` (n, 2), footprints `sigma` (n,) in tile widths, seen from
        `omega_o` (n, 3)."""

    @abstractmethod
    def stage2(self, features: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Value (n, 3) in 1/sr under light from `omega_i` (n, 3). Not clamped: it may fall below zero."""

    def forward(self, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Both stages."""
        return self.stage2(self.stage1(u, sigma, omega_o), omega_i, omega_o)

    def crops(self, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Values (items, rows, columns, 3) of crops of buffers, as in training.

        Parameters
        ----------
        u : (items, rows+2·margin, columns+2·margin, 2) places
        sigma : (items,); omega_i, omega_o : (items, 3), shared by an item's places
        """
        places = u.shape[1] * u.shape[2]
        each = (a.repeat_interleave(places, 0) for a in (sigma, omega_i, omega_o))
        value: Tensor = self(u.reshape(-1, 2), *each)
        return value.view(*u.shape[:3], 3)

    def offset(self, u: Tensor, omega_o: Tensor) -> Tensor:
        """By how much the model moves its lookup, (n, 2) in tile widths; zero where it does not."""
        return torch.zeros_like(u)

    def textures(self) -> list[FeatureTextures]:
        """The model's learned textures."""
        return [module for module in self.modules() if isinstance(module, FeatureTextures)]

    def parameter_groups(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        """(texels, network weights)."""
        texels = [module.texels for module in self.textures()]
        known = {id(p) for p in texels}
        return texels, [p for p in self.parameters() if id(p) not in known]

    @abstractmethod
    def formula(self) -> dict[str, str]:
        """How the value is computed from :meth:`weights`, for a reader of the export."""

    def weights(self) -> dict[str, Tensor]:
        """All numbers of the model by name, as it evaluates now: textures blurred, one tensor (rows, columns,
        channels) per level; network layers as ``NAME.0.weight`` (outputs, inputs) and ``NAME.0.bias``,
        convolutions as ``NAME.weight`` (outputs, inputs, rows, columns)."""
        out = {name: buffer.detach().clone() for name, buffer in self.named_buffers()}
        for name, module in self.named_modules():
            if isinstance(module, _PARTS):
                out |= {f"{name}.{key}": tensor for key, tensor in module.export().items()}
        return out

    def load_weights(self, tensors: dict[str, Tensor]) -> None:
        """Take over what :meth:`weights` gave.

        Raises
        ------
        InputError : a tensor is missing, of another shape, or unknown
        """
        mine = self.weights()
        for name in sorted({*mine, *tensors}):
            if name not in tensors or name not in mine or tensors[name].shape != mine[name].shape:
                raise InputError(f"the weights do not fit the model {self.name}: '{name}'")
        with torch.no_grad():
            for name, buffer in self.named_buffers():
                buffer.copy_(tensors[name])
            for name, module in self.named_modules():
                if isinstance(module, _PARTS):
                    module.load({k.removeprefix(f"{name}."): t for k, t in tensors.items()})

    def level(self, sigma: Tensor) -> Tensor:
        """Fractional level ``-log2(2σ)`` of footprints, clamped to the lattice's levels."""
        return -torch.log2(2.0 * sigma).clamp(-float(self.lattice.finest), 0.0)

"""Interface of all models to trainer, exporter and renderers."""

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

# Modules that export and load their tensors by name.
_PARTS = (FeatureTextures, Mlp, InceptionDecoder)


class NeuralMaterial(nn.Module, ABC):
    """A model of ``M(u, σ, ω_i, ω_o)`` in two stages, a function of each query alone.

    Stage 1 does not depend on the light; stage 2 is evaluated once per light.

    Parameters
    ----------
    lattice : Lattice
        Texel grids of the tile.
    network : NetworkSection
        Architecture.

    Attributes
    ----------
    name : str
        Name in configurations and materials.
    layout : str
        Layout of the shards that it is trained on.
    """

    name: ClassVar[str]
    layout: ClassVar[Layout]

    def __init__(self, lattice: Lattice, network: NetworkSection) -> None:
        super().__init__()
        self.lattice = lattice
        self.network = network

    @property
    def margin(self) -> int:
        """Radius of the neighborhood that the value depends on, in texels of the nearest level."""
        return 0

    @property
    def positions(self) -> int:
        """Positions at which stage 1 reads the textures for one query."""
        return (2 * self.margin + 1) ** 2

    @abstractmethod
    def initialize(self, generator: torch.Generator, unit: float) -> None:
        """Initialize all parameters at random.

        Parameters
        ----------
        generator : torch.Generator
            Random numbers.
        unit : float
            Typical value of the data in 1/sr. Values are multiples of it, so that black data (0) are fitted
            exactly.
        """

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

    def evaluate_patches(self, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Values (items, rows, columns, 3) of patches, as in training.

        Parameters
        ----------
        u : (items, rows+2·margin, columns+2·margin, 2) positions
        sigma : (items,); omega_i, omega_o : (items, 3), shared by the positions of an item
        """
        count = u.shape[1] * u.shape[2]
        each = (a.repeat_interleave(count, 0) for a in (sigma, omega_i, omega_o))
        value: Tensor = self(u.reshape(-1, 2), *each)
        return value.view(*u.shape[:3], 3)

    def offset(self, u: Tensor, omega_o: Tensor) -> Tensor:
        """Neural offset of the lookup, (n, 2) in tile widths; zero for a model without offset."""
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
        """Formulas of the value in terms of :meth:`weights`, as text for an export."""

    def weights(self) -> dict[str, Tensor]:
        """All tensors of the model by name, with the current blur: one tensor (rows, columns, channels) per
        level of a texture; network layers as ``NAME.0.weight`` (outputs, inputs) and ``NAME.0.bias``,
        convolutions as ``NAME.weight`` (outputs, inputs, rows, columns)."""
        out = {name: buffer.detach().clone() for name, buffer in self.named_buffers()}
        for name, module in self.named_modules():
            if isinstance(module, _PARTS):
                out |= {f"{name}.{key}": tensor for key, tensor in module.export().items()}
        return out

    def load_weights(self, tensors: dict[str, Tensor]) -> None:
        """Load tensors of :meth:`weights`.

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

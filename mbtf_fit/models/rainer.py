"""Neural compression of BTFs: an encoder of angular slices, a texture of latents, and a decoder.

- ``rainer2019``: Rainer, Jakob, Ghosh, Weyrich: *Neural BTF Compression and Interpolation*, Computer Graphics
  Forum 38(2), 2019. Encoder and decoder are trained for one material.
- ``rainer2020``: Rainer, Ghosh, Jakob, Weyrich: *Unified Neural Encoding of BTFs*, Computer Graphics Forum
  39(2), 2020. One encoder and decoder for many materials; the encoder takes any number of directions.

Neither paper has public code. Kuznetsov et al. 2021 count 35 725 and 38 269 weights of the decoders, and 14
and 38 channels. Exactly these result from four hidden layers of 106 units that read 8 and 32 latents and two
coordinates of light and view each, where the texture also holds mean and standard deviation of every color.

A texel's slice is its apparent BRDF times the cosine of the light. Its logarithm is normalized per texel and
color before it is encoded, and the decoder's output is scaled back. Coarser levels average the texture of the
finest one.

The encoders are our own, because the papers' are not public in numbers: for 2019 a network of two hidden
layers of 106 units that reads the whole slice; for 2020 one that reads each sample with its directions, an
average over the samples, and another network.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import Layout
from mbtf_fit.config import NetworkSection
from mbtf_fit.data.slices import SliceBatch, TrainingSlices
from mbtf_fit.models.constants import LEAST_COSINE, STATISTICS
from mbtf_fit.models.interface import NeuralMaterial
from mbtf_fit.models.mlp import Mlp, initialize_layers

# Least standard deviation of a slice's logarithms.
LEAST_DEVIATION = 1e-3
# Samples that are encoded at once when the texture is written.
_AT_ONCE = 1 << 19


def stereographic(omega: Tensor) -> Tensor:
    """Directions (n, 3) projected from the nadir: (x, y) / (1 + z)."""
    return omega[..., :2] / (1.0 + omega[..., 2:])


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


class Rainer2019(NeuralMaterial):
    """Latents from an encoder, trained for one material.

    Attributes
    ----------
    encoder : used in training alone, no part of the material; None until :meth:`prepare`
    """

    name = "rainer2019"
    layout: ClassVar[Layout] = "slices"

    def __init__(self, lattice: Lattice, network: NetworkSection) -> None:
        super().__init__(lattice, network)
        self.encoder: SliceEncoder | SetEncoder | None = None

    @classmethod
    def texture_channels(cls, network: NetworkSection) -> int:
        return network.channels + STATISTICS

    def prepare(self, pairs: int, generator: torch.Generator) -> None:
        """Create the encoder of slices at so many pairs of light and view."""
        self.encoder = SliceEncoder(pairs, self.network.width, self.network.channels)
        self.encoder.initialize(generator)

    def trained(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        assert self.encoder is not None
        return [], [*self.decoder.parameters(), *self.encoder.parameters()]

    def _layers(self) -> dict[str, nn.Parameter]:
        return {name: p for name, p in super()._layers().items() if not name.startswith("encoder.")}

    def directions(self, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        return torch.cat([stereographic(omega_i), stereographic(omega_o)], 1)

    def stage1(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> Tensor:
        return self.features(u, sigma, omega_o)

    def stage2(self, features: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        latents, mean, deviation = features.tensor_split([-6, -3], 1)
        x = self.decoder(torch.cat([latents, self.directions(omega_i, omega_o)], 1))
        return self.unit * torch.expm1(mean + deviation * x) / omega_i[:, 2:].clamp_min(LEAST_COSINE)

    def normalized(self, values: Tensor, omega_i: Tensor) -> tuple[Tensor, Tensor]:
        """Logarithms (items, D, 3) of slices with mean 0 and variance 1 per item and color, and both (items,
        6)."""
        # Black data have no unit.
        unit = torch.where(self.unit > 0, self.unit, torch.ones_like(self.unit))
        apparent = (values * omega_i[:, 2:]).clamp_min(0.0) / unit
        logarithm = torch.log1p(apparent)
        mean = logarithm.mean(1, keepdim=True)
        deviation = logarithm.std(1, unbiased=False, keepdim=True).clamp_min(LEAST_DEVIATION)
        return (logarithm - mean) / deviation, torch.cat([mean, deviation], 2)[:, 0]

    def encode(self, values: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Texture values (items, channels) of slices (items, D, 3)."""
        assert self.encoder is not None
        normalized, statistics = self.normalized(values, omega_i)
        pairs = self.directions(omega_i, omega_o)
        return torch.cat([self.encoder(normalized, pairs), statistics], 1)

    def encoded(self, batch: SliceBatch) -> Tensor:
        """Texture values (items, channels) of a batch."""
        return self.encode(batch.values, batch.omega_i, batch.omega_o)

    def reconstruct(self, batch: SliceBatch) -> Tensor:
        """Values (items · K, 3) of the pairs that a batch decodes."""
        features = self.encoded(batch)
        pair = batch.chosen.flatten()
        repeated = features.repeat_interleave(batch.chosen.shape[1], 0)
        return self.stage2(repeated, batch.omega_i[pair], batch.omega_o[pair])

    def write_textures(self, slices: TrainingSlices) -> None:
        """Encode all slices, and average them for the coarser levels."""
        with torch.no_grad():
            step = max(1, _AT_ONCE // slices.values.shape[1])
            parts = [
                self.encode(slices.values[a : a + step], slices.omega_i, slices.omega_o)
                for a in range(0, len(slices.values), step)
            ]
            finest = torch.cat(parts)
            self.pyramid.texels[-len(finest) :] = finest
        self.pyramid.average_coarser(self.lattice.finest)

    def formula(self) -> dict[str, str]:
        return {
            "features": "the textures pyramid.0 ... pyramid.k (level 0 to k) at u, blended by level: "
            "latents, then mean m (RGB) and standard deviation d (RGB)",
            "light, view": "(x, y) / (1 + z) of omega_i, of omega_o",
            "x": "decoder(latents, light, view)",
            "value": f"unit * (exp(m + d * x) - 1) / max(omega_i.z, {LEAST_COSINE})",
        }


class Rainer2020(Rainer2019):
    """Latents from an encoder of any set of samples, trained for many materials."""

    name = "rainer2020"

    def prepare(self, pairs: int, generator: torch.Generator) -> None:
        self.encoder = SetEncoder(self.network.width, self.network.channels)
        self.encoder.initialize(generator)

    def encoded(self, batch: SliceBatch) -> Tensor:
        """Texture values, from a random part of the slices."""
        read = batch.read
        return self.encode(batch.values[:, read], batch.omega_i[read], batch.omega_o[read])

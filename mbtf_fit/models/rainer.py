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

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit.models.model import Model, Preparation, generator_of
from mbtf_fit.models.neumip import hidden_layers
from mbtf_fit.ops import DivideByCosine, Lookup, Network, Operation, Standardize, Stereographic, Transform
from mbtf_fit.ops.constants import LEAST_COSINE, STATISTICS
from mbtf_fit.sections import NetworkSection

if TYPE_CHECKING:
    from torch import Tensor, nn

    from mbtf_fit.data.layouts import SliceBatch, TrainingSlices
    from mbtf_fit.pytorch.material import NeuralMaterial
    from mbtf_fit.pytorch.networks import SetEncoder, SliceEncoder

# Least standard deviation of a slice's logarithms.
LEAST_DEVIATION = 1e-3
# Samples that are encoded at once when the texture is written.
_AT_ONCE = 1 << 19


class Rainer2019(Model):
    """Latents from an encoder, trained for one material.

    Attributes
    ----------
    encoder : used in training alone, no part of the material; None until :meth:`prepare`
    """

    name = "rainer2019"
    description = "encodes angular slices (Rainer et al. 2019)"
    layout = "slices"
    # 8 latents; the texture has six channels more.
    defaults: ClassVar[Mapping[str, Any]] = {
        "network": {"offset": "none", "channels": 8, "width": 106, "layers": 5},
        "training": {"learning_rate": 3e-3},
    }
    takes: ClassVar[Sequence[str]] = (
        "network.channels",
        "network.width",
        "network.layers",
        "network.activation",
    )
    calibrates = False

    @classmethod
    def operations(cls, lattice: Lattice, network: NetworkSection) -> list[Operation]:
        latents = network.channels
        m, d, end = latents, latents + 3, latents + STATISTICS
        return [
            # Latents, then mean m and standard deviation d of each color.
            Lookup("texture", "u", "level", "pyramid", end),
            Stereographic("light", "omega_i"),
            Stereographic("view", "omega_o"),
            # (B3) x = F(latents, light, view)
            Network(
                "x",
                (f"texture[0:{latents}]", "light", "view"),
                weights="decoder",
                hidden=hidden_layers(network),
                outputs=3,
                activation=network.activation,
            ),
            # (B2) M = unit · (exp(m + d x) - 1) / ω_i,z
            Standardize("logarithm", "x", f"texture[{m}:{d}]", f"texture[{d}:{end}]"),
            Transform("radiance", "logarithm", "expm1", factor="unit"),
            DivideByCosine("value", "radiance", "omega_i", LEAST_COSINE),
        ]

    def __init__(self, material: NeuralMaterial) -> None:
        super().__init__(material)
        self.encoder: SliceEncoder | SetEncoder | None = None
        texture = material.operations[0]
        assert isinstance(texture, Lookup)
        self.latents = texture.channels - STATISTICS

    def _encoder(self, pairs: int) -> SliceEncoder | SetEncoder:
        """An encoder of slices at so many pairs of light and view."""
        from mbtf_fit.pytorch.networks import SliceEncoder

        return SliceEncoder(pairs, self._width(), self.latents)

    def _width(self) -> int:
        """Units of the encoder's layers: those of the decoder."""
        return next(op.hidden[0] for op in self.material.operations if isinstance(op, Network))

    def prepare(self, given: Preparation) -> Any:
        from mbtf_fit.pytorch.networks import initialize_layers

        queries = given.queries
        self.encoder = self._encoder(len(queries.omega_i))
        generator = generator_of(given.seed + 1)
        for network in self.encoder.children():
            initialize_layers(network, generator)
        self.encoder.to(queries.values.device)
        return shared_slices(given)

    def trained(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        assert self.encoder is not None
        (decoder,) = self.material.networks().values()
        return [], [*decoder.parameters(), *self.encoder.parameters()]

    def parameters(self) -> dict[str, Tensor]:
        assert self.encoder is not None
        return {f"encoder.{name}": p for name, p in self.encoder.named_parameters()}

    def predict(self, batch: SliceBatch) -> tuple[Tensor, Any]:
        """Values (items · K, 3) of the pairs that a batch decodes."""
        features = self.encoded(batch)
        pair = batch.chosen.flatten()
        repeated = features.repeat_interleave(batch.chosen.shape[1], 0)
        value = self.material.stage2({"texture": repeated}, batch.omega_i[pair], batch.omega_o[pair])
        return value, batch.queries()

    def normalized(self, values: Tensor, omega_i: Tensor) -> tuple[Tensor, Tensor]:
        """Logarithms (items, D, 3) of slices with mean 0 and variance 1 per item and color, and both (items,
        6)."""
        import torch

        # (B1) z = encoder((y - m) / d), y = log(1 + M ω_i,z / unit). Black data have no unit.
        unit = self.material.number("unit")
        unit = torch.where(unit > 0, unit, torch.ones_like(unit))
        apparent = (values * omega_i[:, 2:]).clamp_min(0.0) / unit
        logarithm = torch.log1p(apparent)
        mean = logarithm.mean(1, keepdim=True)
        deviation = logarithm.std(1, unbiased=False, keepdim=True).clamp_min(LEAST_DEVIATION)
        return (logarithm - mean) / deviation, torch.cat([mean, deviation], 2)[:, 0]

    def encode(self, values: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Texture values (items, channels) of slices (items, D, 3)."""
        import torch

        from mbtf_fit.pytorch.operations import stereographic

        assert self.encoder is not None
        normalized, statistics = self.normalized(values, omega_i)
        pairs = torch.cat([stereographic(omega_i), stereographic(omega_o)], 1)
        return torch.cat([self.encoder(normalized, pairs), statistics], 1)

    def encoded(self, batch: SliceBatch) -> Tensor:
        """Texture values (items, channels) of a batch."""
        return self.encode(batch.values, batch.omega_i, batch.omega_o)

    def write_textures(self, queries: Any) -> bool:
        """Encode all slices, and average them for the coarser levels."""
        import torch

        slices: TrainingSlices = getattr(queries, "own", queries)
        pyramid = self.material.texture("pyramid")
        with torch.no_grad():
            step = max(1, _AT_ONCE // slices.values.shape[1])
            parts = [
                self.encode(slices.values[a : a + step], slices.omega_i, slices.omega_o)
                for a in range(0, len(slices.values), step)
            ]
            finest = torch.cat(parts)
            pyramid.texels[-len(finest) :] = finest
        pyramid.average_coarser(self.material.lattice.finest)
        return True


class Rainer2020(Rainer2019):
    """Latents from an encoder of any set of samples, trained for many materials."""

    name = "rainer2020"
    description = "encodes angular slices, with one network for many materials (Rainer et al. 2020)"
    # 32 latents; the texture has six channels more.
    defaults: ClassVar[Mapping[str, Any]] = {
        "network": {"offset": "none", "channels": 32, "width": 106, "layers": 5},
        "training": {"learning_rate": 3e-3},
    }
    takes = (*Rainer2019.takes, "training.materials", "training.own_material")

    def _encoder(self, pairs: int) -> SliceEncoder | SetEncoder:
        from mbtf_fit.pytorch.networks import SetEncoder

        return SetEncoder(self._width(), self.latents)

    def encoded(self, batch: SliceBatch) -> Tensor:
        """Texture values, from a random part of the slices."""
        read = batch.read
        return self.encode(batch.values[:, read], batch.omega_i[read], batch.omega_o[read])


def shared_slices(given: Preparation) -> Any:
    """The slices that a network learns: those of one material, or of several, all in units of the first."""
    from mbtf_fit.data.layouts import SharedSlices

    own, training = given.queries, given.training
    if not (training.materials or training.own_material):
        raise InputError(
            "there is nothing to learn from without the material itself",
            where="training.own_material",
            hint="add folders of slices of other materials: training.materials",
        )
    if not training.materials:
        return own
    learned = [own] if training.own_material else []
    for folder in training.materials:
        slices, typical = given.load(folder)
        learned.append(slices.scaled(given.unit / typical if typical > 0 else 1.0))
    return SharedSlices(own, learned)

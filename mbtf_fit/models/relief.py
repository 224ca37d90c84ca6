"""Relief: a neural material that traces the heights it knows.

NeuMIP's decoder and pyramid of learned textures (:mod:`mbtf_fit.models.neumip`), without the offset network.
The view ray is intersected with the stored heights instead (relief mapping: Policarpo, Oliveira and Comba,
I3D 2005). The textures are read at ``u' = u + w_l · z/ω_o,z · ω_o,xy``, where z is the height of the
intersection and w_l a learned weight of the level. The decoder sees :mod:`hints <mbtf_fit.surface.known>` of
the known surface besides features and directions (shadow and highlight hints: Zeng et al., SIGGRAPH 2023;
difference vector: Rusinkiewicz, EGSR 1998), and the value is the sum of its own part and of the known
surface's single scattering, scaled by a learned gate:

    M = 2 σ(g) · core + unit · (exp(x) - 1),    σ(g) = 1 / (1 + exp(-g)).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit.config import NetworkSection
from mbtf_fit.models.constants import IRRADIANCE_SCALE, hint_size
from mbtf_fit.models.encodings import rotate_to_z
from mbtf_fit.models.lookup import coarse_level
from mbtf_fit.models.neumip import Neumip
from mbtf_fit.models.outputs import output_formula
from mbtf_fit.surface.formulas import surface_formula
from mbtf_fit.surface.hints import compute_hints
from mbtf_fit.surface.known import KnownSurface

# Weight of the displacement at all levels before training.
FIRST_WEIGHT = 0.9


class Relief(Neumip):
    """A model that knows heights and maps of the surface.

    Attributes
    ----------
    surface : KnownSurface or None
        None until :meth:`know` or :meth:`load_weights`.
    depth_weights : (levels,) parameter
        Weight of the traced displacement at each level.
    """

    name = "relief"

    def __init__(self, lattice: Lattice, network: NetworkSection) -> None:
        super().__init__(lattice, network)
        self.surface: KnownSurface | None = None
        self.depth_weights = nn.Parameter(torch.full((lattice.finest + 1,), FIRST_WEIGHT))

    @classmethod
    def hint_size(cls, network: NetworkSection) -> int:
        return hint_size(network)

    @classmethod
    def gate_size(cls, network: NetworkSection) -> int:
        return int(network.relief.gate)

    def know(self, surface: KnownSurface) -> None:
        """Set heights and maps of the surface."""
        self.surface = surface

    @property
    def known(self) -> KnownSurface:
        """Heights and maps of the surface."""
        assert self.surface is not None, "the model has no surface yet"
        return self.surface

    def hints(self, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Hints (n, 7) of queries."""
        with torch.no_grad():
            return compute_hints(self.known, u, sigma, omega_i, omega_o, self.network.relief.places)

    def forward(
        self, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor, hints: Tensor | None = None
    ) -> Tensor:
        """Value (n, 3) in 1/sr; `hints` (n, 7) are computed where they are not given."""
        if hints is None:
            hints = self.hints(u, sigma, omega_i, omega_o)
        level = self.level(sigma)
        features = self.read(self.displaced(u, level, hints[:, :1], omega_o), level)
        value = self._value(features, hints, omega_i, omega_o)
        return value * self.calibration_factors(sigma, omega_i, omega_o)

    def displaced(self, u: Tensor, level: Tensor, height: Tensor, omega_o: Tensor) -> Tensor:
        """Positions (n, 2) at which the learned textures are read, for heights (n, 1) of intersections."""
        slope = height * omega_o[:, :2] / omega_o[:, 2:]
        return u + self.depth_weight(level)[:, None] * slope / u.new_tensor([1.0, self.lattice.aspect])

    def depth_weight(self, level: Tensor) -> Tensor:
        """Weight (n,) of the displacement at fractional levels (n,)."""
        coarse, finer = coarse_level(level, self.lattice.finest + 1)
        index = coarse.long()
        weights = self.depth_weights
        return torch.lerp(weights[index], weights[(index + 1).clamp_max(len(weights) - 1)], finer)

    def features(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> Tensor:
        """Learned features, level, and uv of the intersections of all places."""
        level = self.level(sigma)
        height, hits = self.known.intersections(u, level, omega_o, self.network.relief.places)
        learned = self.read(self.displaced(u, level, height, omega_o), level)
        return torch.cat([learned, level[:, None], hits], 1)

    def decode(self, features: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        places = self.network.relief.places
        learned, level, hits = features.tensor_split([-1 - 2 * places, -2 * places], 1)
        shading = self.known.shading(hits, level[:, 0], omega_i, omega_o, places)
        return self._value(learned, torch.cat([level, shading], 1), omega_i, omega_o)

    def _value(self, features: Tensor, hints: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Value (n, 3) of learned features and hints (n, 7), whose first column is not used."""
        relief = self.network.relief
        irradiance, slope, core = hints[:, 1:2], hints[:, 2:4], hints[:, 4:7]
        # Black data have no unit: their value is 0.
        core, unit = torch.where(self.unit > 0, core, 0.0), torch.where(self.unit > 0, self.unit, 1.0)
        inputs = [features, self.directions(omega_i, omega_o)]
        if relief.hints:
            inputs += [torch.log1p(IRRADIANCE_SCALE * irradiance), slope, torch.log1p(core / unit)]
        if relief.frame:
            upright = (1.0 - slope.square().sum(1, keepdim=True)).clamp_min(0.0).sqrt()
            normal = torch.cat([slope, upright], 1)
            inputs += [rotate_to_z(normal, omega) for omega in (omega_i, omega_o)]
        out = self.decoder(torch.cat(inputs, 1))
        if not relief.gate:
            return self.to_value(out)
        return self.to_value(out[:, :-1]) + 2.0 * torch.sigmoid(out[:, -1:]) * core

    def offset(self, u: Tensor, omega_o: Tensor) -> Tensor:
        """Displacement (n, 2) of the surface point that is seen at the finest footprint, in tile widths."""
        height = self.known.tracer.trace(u, omega_o)[:, None]
        return height * omega_o[:, :2] / omega_o[:, 2:]

    def weights(self) -> dict[str, Tensor]:
        return super().weights() | self.known.tensors()

    def load_weights(self, tensors: dict[str, Tensor]) -> None:
        known = {name: tensor for name, tensor in tensors.items() if name.startswith("surface.")}
        try:
            self.surface = KnownSurface.from_tensors(known, self.lattice)
        except (KeyError, ValueError) as error:
            raise InputError(f"the weights do not fit the model {self.name}: {error}") from None
        super().load_weights(tensors)

    def formula(self) -> dict[str, str]:
        out = super().formula()
        relief, known = self.network.relief, surface_formula(self.known, self.network.relief.places)
        position = (
            "u' = u + w * z / omega_o.z * (omega_o.x, omega_o.y) / (1, aspect), w = depth_weights at l, "
            "linear between levels,"
        )
        out["features"] = out["features"].replace(" at u,", f" at {position}")
        inputs = ["features", "light, view"]
        if relief.hints:
            inputs.append(f"log(1 + {IRRADIANCE_SCALE:g} e), n.x, n.y, log(1 + core / unit)")
        if relief.frame:
            inputs.append("rotate(n, omega_i), rotate(n, omega_o)")
        out["x"] = f"decoder({', '.join(inputs)})"
        if relief.gate:
            out["x"] += " without its last output, g"
            out["own"] = output_formula(self.network.output_transform, self.network.output_channels)
            value = "own + 2 / (1 + exp(-g)) * core"
            out["value"] = value if self.calibration is None else f"calibration * ({value})"
        if not self.unit:
            out["value"] = "0"
        return known | out

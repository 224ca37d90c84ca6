"""The hierarchical neural material.

Xue, Zhao, Jensen, Montazeri: *A Hierarchical Architecture for Neural Materials*, Computer Graphics Forum
2024: NeuMIP's pyramid and offset, encoded positions and directions, a decoder of Inception modules that reads
neighboring queries, and the fourth root of the value as its output.

Deviations from the paper:

- **The neighbors are positions of the material, not pixels of an image.** The decoder reads a grid of 9 × 9
  samples around the query, one texel of the level nearest to its footprint apart. The value is therefore a
  function of the query alone, as renderers require; in the paper it depends on the neighboring pixels.
- The grid wraps around the tile; the published code pads with zeros.
- Training reads the same grids from images, which have one query at a random position in each texel. For
  queries at the texels' centers, training and evaluation are identical.
- Positions are encoded as ``p = 2u - 1`` with π, so that the encoding is continuous at the tile's seam, and
  before the offset; raw coordinates are omitted.
- Encodings are filtered by the footprint and attenuated, and directions are encoded without π: with the
  paper's choices short fits do not converge (they remain available in ``network.encoding``).
- The output x is the value ``unit · x|x|³``, an odd function.

With ``network.decoder: mlp`` the neighborhood is the query alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models.model import PYRAMID, Model
from mbtf_fit.models.neumip import (
    color,
    encode_directions,
    encode_position,
    hidden_layers,
    neural_offset,
    pyramid,
)
from mbtf_fit.ops import Inception, Neighborhood, Network, Operation
from mbtf_fit.sections import NetworkSection

# Radius that an Inception module adds to the receptive field.
REACH = 2


class Hierarchical(Model):
    """Textures, offset, and a decoder that reads a neighborhood on the material."""

    name = "hierarchical"
    description = "a decoder of Inception modules over a neighborhood (Xue et al. 2024)"
    layout = "image"
    defaults: ClassVar[Mapping[str, Any]] = {
        "network": {
            "decoder": "inception",
            "output_transform": "fourth-root",
            "encoding": {
                "position": 10,
                "direction": 4,
                "direction_pi": False,
                "band_attenuation": True,
                "footprint_filtered": True,
            },
        },
        # Whole images are held out; each has a single light, view and footprint.
        "held_out": {"queries": 0.05},
    }
    takes = (*PYRAMID, "network.offset", "network.decoder")
    calibrates = False

    @classmethod
    def operations(cls, lattice: Lattice, network: NetworkSection) -> list[Operation]:
        modules = network.layers - 2 if network.decoder == "inception" else 0
        # 9 × 9 positions around the query.
        grid: list[Operation] = [Neighborhood("grid", "u", "level", REACH * modules)] if modules else []
        at = "grid" if grid else "u"
        moved, offset = neural_offset(at, network)
        # (X1) e(p) = (sin 2^b π p, cos 2^b π p)
        encoded, position = encode_position(at, network.encoding)
        light_and_view, directions = encode_directions(network.encoding)
        features = ("features", *position)
        outputs, activation = network.output_channels, network.activation
        decoder: Operation
        if network.decoder == "mlp":
            inputs = (*features, *directions)
            decoder = Network("x", inputs, "decoder", hidden_layers(network), outputs, activation)
        else:
            shared = tuple(directions)
            decoder = Inception("x", features, shared, "decoder", network.width, modules, outputs, activation)
        # (X2) x = F(features of all positions, directions);  M = unit · x |x|³
        return [
            *grid,
            *offset,
            pyramid(moved, network),
            *encoded,
            *light_and_view,
            decoder,
            *color("x", network),
        ]

    def predict(self, batch: Any) -> tuple[Any, Any]:
        value = self.material.evaluate_patches(batch.u, batch.sigma, batch.omega_i, batch.omega_o)
        return value, batch

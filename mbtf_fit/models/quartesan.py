"""Neural Bidirectional Texture Function Compression and Rendering.

Quartesan, Pereira Santos: SIGGRAPH Asia 2022 Posters. NeuMIP (:mod:`mbtf_fit.models.neumip`) with sines in
place of its ReLUs (*Sin*; SIREN: Sitzmann et al. 2020), and the features of four levels side by side in place
of a blend of two (*Cat*). Sizes are those of the published code: four channels per level, three hidden layers
of 32 units.

Deviations from the paper and its code:

- The four levels are the query's, blended of its two neighbors as in NeuMIP, and those coarser by 1, 2 and 3.
  The code reads four levels of fixed size, and zeros those finer than the query's.
- The offset texture is NeuMIP's, of the finest level alone; the code reads four levels of it, too.
- SIREN's layers are ``sin(30 (W x + b))``. Here W holds the factor 30: hidden layers start with the same
  variance, the first one like them.
- Values are ``unit · (exp(x) - 1)``, not x; losses and learning rates are those of the other models. With
  3e-3, 30 times that of the code, fits of a few hundred steps do not converge.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models.neumip import Neumip, color, encode_directions, hidden_layers, neural_offset
from mbtf_fit.ops import Lookup, Network, Operation
from mbtf_fit.sections import NetworkSection

# Levels whose features the decoder reads.
_LEVELS = 4


class Quartesan(Neumip):
    """NeuMIP with sines, and features of several levels."""

    name = "quartesan2022"
    description = "sines, and features of four levels (Quartesan and Pereira Santos 2022)"
    defaults: ClassVar[Mapping[str, Any]] = {"network": {"channels": 4, "width": 32, "activation": "sine"}}

    @classmethod
    def operations(cls, lattice: Lattice, network: NetworkSection) -> list[Operation]:
        moved, offset = neural_offset("u", network)
        light_and_view, directions = encode_directions(network.encoding)
        # (Q1) P(u', σ), P(u', 2σ), P(u', 4σ), P(u', 8σ)
        features = [
            Lookup(f"features_{k}", moved, "level", "pyramid", network.channels, network.oversampling, -k)
            for k in range(_LEVELS)
        ]
        return [
            *offset,
            *features,
            *light_and_view,
            # x = F(features, ω_i, ω_o), sines between layers
            Network(
                "x",
                (*(lookup.output for lookup in features), *directions),
                weights="decoder",
                hidden=hidden_layers(network),
                outputs=network.output_channels,
                activation=network.activation,
            ),
            *color("x", network),
        ]

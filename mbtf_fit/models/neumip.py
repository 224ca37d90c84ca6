"""NeuMIP: Multi-Resolution Neural Materials.

Kuznetsov, Mullia, Xu, Hašan, Ramamoorthi: ACM Transactions on Graphics 40(4), article 175, 2021. A pyramid of
learned textures is read at the query's footprint; a small network decodes the features, together with
light and view direction, into color. A second texture and network shift the lookup along the view
direction, which reproduces parallax (the *neural offset*).

Deviations from the paper:

- Levels are blended with ``1 - frac(l)`` and ``frac(l)``; the printed weights both vanish at whole levels.
- The decoder has the 3 outputs of the paper's text. Its weight count of 3332 is that of 6 outputs (in the
  published code: YUV and a gate; ``network.output_channels: 6``); with 3 it is 3254.
- No final ReLU in training: the gradient of an output below zero would vanish. Materials clamp at inference.
- Values are ``unit · (exp(x) - 1)`` with a robust mean of the data as the unit, so that training does not
  depend on the brightness of the material; the paper's unit is 1.
- The offset network's output r is scaled by 0.1 and the offset texture starts at zero, as in the published
  code.
- The tile may be non-square, r is a length in tile widths: the v-component is divided by the aspect.
- Losses, blur, decay of texels and calibration: see docs/explanation/training.md.
- Directions outside the upper hemisphere are undefined; the caller ensures z > 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models.model import PYRAMID, SHARED, Model
from mbtf_fit.ops import (
    Frequencies,
    Gate,
    HalfVector,
    Lookup,
    Matrix,
    Network,
    Offset,
    Operation,
    Position,
    Rotate,
    Transform,
)
from mbtf_fit.ops.constants import GATE
from mbtf_fit.sections import EncodingSection, NetworkSection


class Neumip(Model):
    """NeuMIP with the neural offset."""

    name = "neumip"
    description = "NeuMIP with the neural offset (Kuznetsov et al. 2021)"
    takes: ClassVar[Sequence[str]] = (*PYRAMID, *SHARED, "network.offset")

    @classmethod
    def operations(cls, lattice: Lattice, network: NetworkSection) -> list[Operation]:
        # (N1) section 4.3: u' = u + r / max(ω_o,z, 0.6) · ω_o,xy,  r = F_off(T_off(u), ω_o,xy)
        moved, offset = neural_offset("u", network)
        encoded, position = encode_position("u", network.encoding)
        light_and_view, directions = encode_directions(network.encoding)
        return [
            *offset,
            # (N2) section 4.2: P(u', σ), bilinear in a level, linear between the two nearest levels
            pyramid(moved, network),
            *encoded,
            *light_and_view,
            # (N3) section 4.1: x = F(P(u', σ), ω_i,xy, ω_o,xy), 4 layers of 25 units
            Network(
                "x",
                ("features", *position, *directions),
                weights="decoder",
                hidden=hidden_layers(network),
                outputs=network.output_channels,
                activation=network.activation,
            ),
            # Section 5: M = exp(x) - 1
            *color("x", network),
        ]


class NeumipBaseline(Neumip):
    """NeuMIP without the neural offset."""

    name = "neumip-baseline"
    description = "NeuMIP without its offset"
    defaults: ClassVar[Mapping[str, Any]] = {"network": {"offset": "none"}}
    takes = PYRAMID


def hidden_layers(network: NetworkSection) -> tuple[int, ...]:
    """Units of the layers between of each fully connected network."""
    return (network.width,) * (network.layers - 1)


def neural_offset(u: str, network: NetworkSection) -> tuple[str, list[Operation]]:
    """Name of the position at which the pyramid is read, and the operations that compute it from `u`."""
    if network.offset == "none":
        return u, []
    return "moved", [
        Lookup("offset_features", u, None, "offset_texture", network.channels),
        Network(
            "r",
            ("offset_features", "omega_o[0:2]"),
            weights="offset_network",
            hidden=hidden_layers(network),
            outputs=1 if network.offset == "depth" else 2,
            activation=network.activation,
        ),
        Offset("moved", u, "r", "omega_o"),
    ]


def pyramid(u: str, network: NetworkSection) -> Operation:
    """The features at a position and level."""
    return Lookup("features", u, "level", "pyramid", network.channels, network.oversampling)


def encode_position(u: str, encoding: EncodingSection) -> tuple[list[Operation], Sequence[str]]:
    """Operations that encode a position, and names of their results; none without bands."""
    if encoding.position == 0:
        return [], []
    level = "level" if encoding.footprint_filtered else None
    options = encoding.position, encoding.pi, encoding.raw, encoding.band_attenuation
    return [Position("p", u), Frequencies("position", "p", level, *options)], ["position"]


def encode_directions(encoding: EncodingSection) -> tuple[list[Operation], Sequence[str]]:
    """Operations that encode light and view, and names of their results."""
    names = ["omega_i", "omega_o"] if encoding.direction_xyz else ["omega_i[0:2]", "omega_o[0:2]"]
    out: list[Operation] = []
    if encoding.direction:
        options = encoding.direction, encoding.direction_pi, encoding.raw, encoding.band_attenuation
        encoded = zip(("light", "view"), names, strict=True)
        out = [Frequencies(name, omega, None, *options) for name, omega in encoded]
        names = ["light", "view"]
    if encoding.half_vector:
        out += [HalfVector("half", "omega_i", "omega_o"), Rotate("difference", "half", "omega_i")]
        names = [*names, "half", "difference"]
    return out, names


def color(x: str, network: NetworkSection, name: str = "value") -> list[Operation]:
    """Value in 1/sr of three outputs, or of six: YUV and a gate per color, as in the published code."""
    if network.output_channels == 3:
        return [Transform(name, x, network.output_transform, factor="unit", most="most")]
    return [
        Matrix("rgb", f"{x}[0:3]"),
        Transform("ungated", "rgb", network.output_transform, factor="unit", most="most"),
        Gate(name, f"{x}[3:6]", "ungated", floor=GATE),
    ]

"""Relief: a neural material that traces the heights it knows.

NeuMIP's decoder and pyramid of learned textures (:mod:`mbtf_fit.models.neumip`), without the offset network.
The view ray is intersected with the stored heights instead (relief mapping: Policarpo, Oliveira and Comba,
I3D 2005). The textures are read at ``u' = u + w_l · z/ω_o,z · ω_o,xy``, where z is the height of the
intersection and w_l a learned weight of the level. The decoder sees hints of the known surface
(:mod:`mbtf_fit.ops.shade`) besides features and directions (shadow and highlight hints: Zeng et al., SIGGRAPH
2023; difference vector: Rusinkiewicz, EGSR 1998), and the value is the sum of its own part and of the known
surface's single scattering, scaled by a learned gate:

    M = 2 σ(g) · core + unit · (exp(x) - 1),    σ(g) = 1 / (1 + exp(-g)).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

from mbtf_core.data.lattice import Lattice
from mbtf_fit.data.queries import QUERY_BYTES
from mbtf_fit.models.model import PYRAMID, SHARED, Model, Preparation
from mbtf_fit.models.neumip import color, encode_directions, encode_position, hidden_layers, pyramid
from mbtf_fit.ops import Displace, Gate, Network, Operation, Rotate, Shade, Trace, Transform
from mbtf_fit.ops.constants import (
    DIELECTRIC,
    FIBER_HINTS,
    HEIGHTS,
    HINTS,
    HORIZONS,
    IRRADIANCE_SCALE,
    LIGHT_DEPTH,
    LIGHT_WIDTH,
    MAPS,
    PLACES,
)
from mbtf_fit.sections import NetworkSection

# Bytes of a hint in memory.
HINT_BYTES = 4


class Relief(Model):
    """A model that knows heights and maps of the surface."""

    name = "relief"
    description = "traces the heights of the data's geometry"
    defaults: ClassVar[Mapping[str, Any]] = {
        "network": {
            "offset": "none",
            "channels": 8,
            "oversampling": 2,
            "encoding": {"direction_xyz": True, "half_vector": True},
        },
        # Oversampled texels see a quarter of the queries each: with a decay of 1, glossy materials overfit.
        "training": {"residual_levels": True, "texture_weight_decay": 2.0, "blur": {"min_sigma": 1.6}},
    }
    reads_geometry: ClassVar[Sequence[str]] = ("height",)
    takes = (
        *PYRAMID,
        *SHARED,
        *(f"network.relief.{n}" for n in ("places", "shadow_rays", "hints", "frame", "gate")),
    )
    # Texture of learned heights, in models that have one.
    learned: ClassVar[str | None] = None
    light_depth: ClassVar[float] = LIGHT_DEPTH

    @classmethod
    def operations(cls, lattice: Lattice, network: NetworkSection) -> list[Operation]:
        relief = network.relief
        encoded, position = encode_position("u", network.encoding)
        light_and_view, directions = encode_directions(network.encoding)
        hints, known = cls.surface_inputs(network)
        core = "surface[3:6]"
        outputs = network.output_channels
        return [
            # z: where the view ray meets the heights; its hints there.
            *known_surface(relief.places, cls.light_depth if relief.shadow_rays else None),
            # (R1) u' = u + w_l z / ω_o,z · ω_o,xy
            Displace("moved", "u", "z", "level", "omega_o", "depth_weights", cls.learned),
            pyramid("moved", network),
            *encoded,
            *light_and_view,
            *hints,
            # (x, g) = F(features, directions, hints)
            Network(
                "x",
                ("features", *position, *directions, *known),
                weights="decoder",
                hidden=hidden_layers(network),
                outputs=outputs + relief.gate,
                activation=network.activation,
            ),
            # unit · (exp(x) - 1)
            *color(f"x[0:{outputs}]" if relief.gate and outputs == 3 else "x", network, "own"),
            # (R3) M = 2 σ(g) core + …
            *(
                [Gate("value", f"x[{outputs}:{outputs + 1}]", core, "own", scale=2.0, unit="unit")]
                if relief.gate
                else []
            ),
        ]

    @classmethod
    def surface_inputs(cls, network: NetworkSection) -> tuple[list[Operation], list[str]]:
        """Operations on hints (irradiance, normal, core), and the inputs of the decoder that they give."""
        out: list[Operation] = []
        names: list[str] = []
        if network.relief.hints:
            out += [
                Transform("log_irradiance", "surface[0:1]", "log1p", scale=IRRADIANCE_SCALE),
                Transform("log_core", "surface[3:6]", "log1p", divisor="unit"),
            ]
            names += ["log_irradiance", "surface[1:3]", "log_core"]
        if network.relief.frame:
            axis = "surface[1:3]"
            out += [Rotate("light_there", axis, "omega_i"), Rotate("view_there", axis, "omega_o")]
            names += ["light_there", "view_there"]
        return out, names

    def prepare(self, given: Preparation) -> Any:
        from mbtf_fit.surface.known import KnownSurface

        geometry = given.data.geometry()
        assert geometry is not None
        width = given.data.light_width or 0.0
        self.material.know(KnownSurface.of(geometry, given.data.lattice, width))
        return given.queries

    def precompute(self, queries: Any, memory: float) -> Any:
        hints = HINTS if self.material.fiber_frame is None else HINTS + FIBER_HINTS
        if not hasattr(queries, "hints") or len(queries) * (QUERY_BYTES + HINT_BYTES * hints) > memory:
            return queries
        return self._with_hints(queries)

    def before_step(self, step: int, fraction: float, sigmas: Mapping[str, float], batch: Any) -> Any:
        return self._with_hints(batch) if batch.hints is None else batch

    def _with_hints(self, queries: Any) -> Any:
        found = self.material.hints(queries.u, queries.sigma, queries.omega_i, queries.omega_o)
        return replace(queries, hints=found)

    def predict(self, batch: Any) -> tuple[Any, Any]:
        at = (batch.u, batch.sigma, batch.omega_i, batch.omega_o)
        return self.material(*at, hints=batch.hints), batch


def known_surface(places: int, light_depth: float | None = None) -> tuple[Trace, Shade]:
    """The operations that trace and shade the surface of a material, for so many places of a footprint; with
    shadow rays where the depth of the light is given."""
    offsets, finer = PLACES[places]
    trace = Trace("z", "hits", "depths", "u", "level", "omega_o", HEIGHTS, offsets)
    tensors = MAPS, HORIZONS, LIGHT_WIDTH, DIELECTRIC
    shadows = () if light_depth is None else ("depths", HEIGHTS, light_depth)
    return trace, Shade("surface", "hits", "level", "omega_i", "omega_o", *tensors, finer, *shadows)

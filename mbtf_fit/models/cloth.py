"""Cloth: a neural material that traces the envelope of fibers and knows their directions.

:mod:`Relief <mbtf_fit.models.relief>` on the heights that fibers show from above, whose decoder also sees the
height of the intersection, as little light comes between yarns, and light and view about the fibers' axis
(:mod:`mbtf_fit.ops.fibers`): fibers scatter light along cones about their axis (Marschner et al., SIGGRAPH
2003), which neither the normal nor the half vector of a surface tells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from mbtf_fit.models.relief import Relief
from mbtf_fit.ops import FiberFrame, Operation, Transform
from mbtf_fit.ops.constants import CLOTH_LIGHT_DEPTH, DEPTH_SCALE, FIBERS, PLACES
from mbtf_fit.sections import NetworkSection


class Cloth(Relief):
    """A model that knows heights and directions of fibers."""

    name = "cloth"
    description = "traces fibers' envelope, and knows their directions"
    defaults: ClassVar[Mapping[str, Any]] = {
        **Relief.defaults,
        "training": {
            **Relief.defaults["training"],
            # Noise of fibers has no such bright paths as that of glossy surfaces, which ask for more.
            "noise_regularization": 0.3,
            # The relative loss alone leaves the grazing highlights of fibers at half their value.
            "losses": [
                {"kind": "relative"},
                {"kind": "chroma", "weight": 3.0},
                {"kind": "squared", "weight": 0.1},
            ],
        },
    }
    reads_geometry: ClassVar[Sequence[str]] = ("height", "tangent_moment.xx")
    light_depth = CLOTH_LIGHT_DEPTH

    @classmethod
    def surface_inputs(cls, network: NetworkSection) -> tuple[list[Operation], list[str]]:
        operations, names = super().surface_inputs(network)
        _, finer = PLACES[network.relief.places]
        fibers = FiberFrame("fibers", "hits", "level", "omega_i", "omega_o", FIBERS, finer)
        depth = Transform("depth", "z", scale=DEPTH_SCALE)
        return [*operations, depth, fibers], [*names, "depth", "fibers"]

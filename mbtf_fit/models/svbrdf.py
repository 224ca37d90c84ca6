"""SVBRDF: the material that engines have, a spatially varying BRDF without a network.

A texel of every level has a base color, a share of metal, a roughness, the slopes of a normal (the metallic
workflow: Burley, *Physically Based Shading at Disney*, SIGGRAPH courses 2012) and a specular weight, which
scales the lobe also at grazing angles (as glTF's KHR_materials_specular does for dielectrics). It has neither
parallax nor shadows, and one lobe per texel: a baseline for all that does.

Microgeometry shadows its highlights. Without the weight, the loss removes a lobe that is too bright by making
it too narrow for the queries to sample, which leaves spikes between them. Roughness and slopes therefore
train slower than colors: lobes start wide, and become narrow only where many queries agree. On glossy
bricks the error rises again in long fits, the more, the faster texels train.

Towards grazing angles every lobe is bright, while parallax and shadows move and remove highlights. The
relative loss of a highlight at the wrong place is bounded, and energy calibration scales it up: such fits can
be worse than a constant. The squared loss is added, and there is no calibration, which engines lack too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models.model import Model
from mbtf_fit.ops import Gate, Lobe, Lookup, Matrix, Operation, Transform
from mbtf_fit.sections import NetworkSection

# Reflectance of dielectrics at normal incidence.
_DIELECTRIC = 0.04
# Scale of the texels of roughness and slopes: their learning rate relative to that of colors.
_SLOW = 0.3


class Svbrdf(Model):
    """A diffuse and a GGX lobe per texel."""

    name = "svbrdf"
    description = "a diffuse and a GGX lobe per texel, without a network"
    defaults: ClassVar[Mapping[str, Any]] = {
        "network": {"offset": "none"},
        "training": {"texture_learning_rate": 0.05, "losses": [{"kind": "relative"}, {"kind": "squared"}]},
    }
    calibrates = False
    takes = ()

    @classmethod
    def operations(cls, lattice: Lattice, network: NetworkSection) -> list[Operation]:
        metal = "texel[3:4]"
        return [
            Lookup("texel", "u", "level", "features", channels=8),
            # (S1) b, m, w = σ(texel), r = σ(0.3 texel), slopes 0.3 texel; diffuse color (1 - m) b,
            # F0 = m b + 0.04 (1 - m), α = r²
            Transform("base_color", "texel[0:3]", "sigmoid"),
            Transform("dielectric", metal, scale=-1.0),
            Gate("diffuse", "dielectric", "base_color"),
            Transform("share", "dielectric", "sigmoid"),
            Matrix("reflectance", "share", rows=((_DIELECTRIC,),) * 3),
            Gate("f0", metal, "base_color", "reflectance"),
            Transform("roughness", "texel[4:5]", "sigmoid", scale=_SLOW),
            Transform("alpha", "roughness", "square"),
            Transform("alpha2", "alpha", "square"),
            Transform("slopes", "texel[5:7]", scale=_SLOW),
            Transform("weight", "texel[7:8]", "sigmoid"),
            Lobe("value", "diffuse", "f0", "alpha2", "slopes", "omega_i", "omega_o", "weight"),
        ]

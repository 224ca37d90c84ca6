"""Models by name."""

from __future__ import annotations

from typing import Any

from mbtf_core.data.lattice import Lattice
from mbtf_fit.config import FitConfig
from mbtf_fit.models.hierarchical import Hierarchical
from mbtf_fit.models.interface import NeuralMaterial
from mbtf_fit.models.learned_relief import LearnedRelief
from mbtf_fit.models.neumip import Neumip, NeumipBaseline
from mbtf_fit.models.rainer import Rainer2019, Rainer2020
from mbtf_fit.models.relief import Relief

MODELS: dict[str, type[NeuralMaterial]] = {
    m.name: m for m in (NeumipBaseline, Neumip, LearnedRelief, Relief, Hierarchical, Rainer2019, Rainer2020)
}


def build_model(name: str, lattice: Lattice, **network: Any) -> NeuralMaterial:
    """An uninitialized model; `network` are keys of the configuration's section, by default the model's."""
    config = FitConfig.model_validate({"model": name, "network": network})
    return MODELS[name](lattice, config.network)

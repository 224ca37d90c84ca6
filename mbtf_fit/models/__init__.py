"""Models by name."""

from __future__ import annotations

from typing import Any

from mbtf_gen.levels import Lattice

from ..config import FitConfig
from .hierarchical import Hierarchical
from .interface import NeuralMaterial
from .neumip import Neumip, NeumipBaseline
from .textured import TexturedMaterial

MODELS: dict[str, type[TexturedMaterial]] = {m.name: m for m in (NeumipBaseline, Neumip, Hierarchical)}


def build_model(name: str, lattice: Lattice, **network: Any) -> TexturedMaterial:
    """An uninitialised model; `network` are keys of the configuration's section of that name, the others as
    the model has them."""
    config = FitConfig.model_validate({"model": name, "network": network})
    return MODELS[name](lattice, config.network)


__all__ = [
    "MODELS",
    "Hierarchical",
    "Neumip",
    "NeumipBaseline",
    "NeuralMaterial",
    "TexturedMaterial",
    "build_model",
]

"""Models by name."""

from __future__ import annotations

from typing import Any

from mbtf_gen.levels import Lattice

from .interface import NeuralMaterial
from .neumip import Neumip, NeumipBaseline

MODELS: dict[str, type[NeuralMaterial]] = {m.name: m for m in (NeumipBaseline, Neumip)}


def build_model(name: str, lattice: Lattice, **architecture: Any) -> NeuralMaterial:
    """An uninitialised model; `architecture` are its constructor's keyword parameters."""
    return MODELS[name](lattice, **architecture)


__all__ = ["MODELS", "Neumip", "NeumipBaseline", "NeuralMaterial", "build_model"]

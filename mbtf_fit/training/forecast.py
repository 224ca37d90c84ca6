"""What a fit takes beside its training: expected seconds, and bytes on disk."""

from __future__ import annotations

import torch

from mbtf_core.data.lattice import Lattice
from mbtf_fit.config import FitConfig
from mbtf_fit.models.registry import material_of
from mbtf_fit.surface.known import surface_bytes


def seconds_besides_training(queries: float) -> float:
    """Expected seconds of a fit of so many queries for reading, hints, energy calibration, errors,
    distillation and writing: of the default model at 64 and 128 texels, on two free cores."""
    return 8.0 + 0.7e-6 * queries


def fit_bytes(config: FitConfig, lattice: Lattice) -> int:
    """Bytes that a fit writes at most: a checkpoint of weights, two moments and the best weights, while it
    replaces another, and the known surface."""
    with torch.device("meta"):
        model = material_of(config.model, lattice, config.network)
    surface = surface_bytes(lattice) if model.tracing is not None else 0
    return 8 * sum(p.nbytes for p in model.parameters()) + surface

"""What a fit takes beside its training: expected seconds, and bytes on disk."""

from __future__ import annotations

import torch

from mbtf_core.data.lattice import Lattice
from mbtf_fit.config import FitConfig
from mbtf_fit.models.registry import material_of
from mbtf_fit.surface.known import surface_bytes

# Seconds of a fit before its training and after it, and those of each query of its data: of the default model
# at 64 and 128 texels, on two cores.
_BEFORE, _AFTER = (3.0, 0.6e-6), (5.0, 0.1e-6)


def preparing_seconds(queries: float) -> float:
    """Expected seconds of a fit before training, for so many queries of data: start, reading, hints."""
    return _BEFORE[0] + _BEFORE[1] * queries


def closing_seconds(queries: float) -> float:
    """Expected seconds of a fit after training: energy calibration, errors, distillation, writing."""
    return _AFTER[0] + _AFTER[1] * queries


def fit_bytes(config: FitConfig, lattice: Lattice) -> int:
    """Bytes that a fit writes at most: a checkpoint of weights, two moments and the best weights, while it
    replaces another, and the known surface."""
    with torch.device("meta"):
        model = material_of(config.model, lattice, config.network)
    surface = surface_bytes(lattice) if model.tracing is not None else 0
    return 8 * sum(p.nbytes for p in model.parameters()) + surface

"""Evaluation of a model on NumPy arrays of any length."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from .models import NeuralMaterial

# Queries that are evaluated at a time: bounds memory and keeps activations in the cache.
_CHUNK = 1 << 15


def evaluate_in_chunks(
    function: Callable[..., Tensor], device: torch.device, outputs: int, *arrays: ArrayLike
) -> NDArray[np.float32]:
    """Apply a function of tensors (n, ...) to arrays (n, ...), piece by piece: (n, outputs)."""
    inputs = [np.asarray(a, np.float32) for a in arrays]
    out = np.empty((len(inputs[0]), outputs), np.float32)
    with torch.no_grad():
        for start in range(0, len(out), _CHUNK):
            part = slice(start, start + _CHUNK)
            # A copy: memory-mapped shards are read-only, which tensors cannot be.
            tensors = (torch.from_numpy(np.array(a[part], order="C")).to(device) for a in inputs)
            out[part] = function(*tensors).cpu().numpy()
    return out


def predict(
    model: NeuralMaterial, u: ArrayLike, sigma: ArrayLike, omega_i: ArrayLike, omega_o: ArrayLike
) -> NDArray[np.float32]:
    """Values (n, 3) in 1/sr of a model, clamped at 0 as materials are."""
    device = next(model.parameters()).device
    return evaluate_in_chunks(
        lambda *arrays: model(*arrays).clamp_min_(0), device, 3, u, sigma, omega_i, omega_o
    )

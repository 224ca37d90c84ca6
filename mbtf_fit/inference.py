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
    function: Callable[..., Tensor],
    device: torch.device,
    outputs: int,
    *arrays: ArrayLike,
    chunk: int = _CHUNK,
) -> NDArray[np.float32]:
    """Apply a function of tensors (n, ...) to arrays (n, ...), `chunk` at a time: (n, outputs)."""
    inputs = [np.asarray(a, np.float32) for a in arrays]
    out = np.empty((len(inputs[0]), outputs), np.float32)
    with torch.no_grad():
        for start in range(0, len(out), chunk):
            part = slice(start, start + chunk)
            # A copy: memory-mapped shards are read-only, which tensors cannot be.
            tensors = (torch.from_numpy(np.array(a[part], order="C")).to(device) for a in inputs)
            out[part] = function(*tensors).cpu().numpy()
    return out


def predict(
    model: NeuralMaterial, u: ArrayLike, sigma: ArrayLike, omega_i: ArrayLike, omega_o: ArrayLike
) -> NDArray[np.float32]:
    """Values (n, 3) in 1/sr of a model, clamped at 0 as materials are."""
    device = next(model.parameters()).device
    arrays = (u, sigma, omega_i, omega_o)
    return evaluate_in_chunks(
        lambda *a: model(*a).clamp_min(0), device, 3, *arrays, chunk=max(1, _CHUNK // model.positions)
    )

"""Evaluation of a model on NumPy arrays of any length."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from mbtf_fit.models.interface import NeuralMaterial
from mbtf_fit.models.neumip import Neumip
from mbtf_fit.models.relief import Relief
from mbtf_fit.native import Kernel, kernel
from mbtf_fit.native.library import QueryPointers
from mbtf_fit.native.model import NativeModel, supports, supports_patches
from mbtf_fit.native.patches import evaluate as evaluate_hierarchical

# Queries per chunk: bounds memory and keeps activations in the cache.
_CHUNK = 1 << 15
# Fewest queries per thread.
_PER_THREAD = 1 << 12


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
    model: NeuralMaterial,
    u: ArrayLike,
    sigma: ArrayLike,
    omega_i: ArrayLike,
    omega_o: ArrayLike,
    *,
    hints: Tensor | None = None,
) -> NDArray[np.float32]:
    """Values (n, 3) of a model in 1/sr, clamped at 0. `hints` (n, 7) of `relief` are computed where they are
    not given."""
    found = kernel()
    if found is not None and supports(model):
        return _predict_natively(found, model, hints, u, sigma, omega_i, omega_o)
    if found is not None and supports_patches(model):
        return _predict_patches(found, model, u, sigma, omega_i, omega_o)
    device = next(model.parameters()).device
    arrays = (u, sigma, omega_i, omega_o, *([] if hints is None else [hints.cpu()]))
    return evaluate_in_chunks(
        lambda *a: model(*a).clamp_min(0), device, 3, *arrays, chunk=max(1, _CHUNK // model.positions)
    )


def _predict_patches(found: Kernel, model: NeuralMaterial, *arrays: ArrayLike) -> NDArray[np.float32]:
    native = NativeModel(found, model)
    inputs = [np.asarray(a, np.float32) for a in arrays]
    n = len(inputs[1])

    def evaluate(start: int, stop: int) -> NDArray[np.float32]:
        part = (a[start:stop] for a in inputs)
        return evaluate_in_chunks(partial(evaluate_hierarchical, native), device, 3, *part, chunk=chunk)

    # Positions take less memory than PyTorch's activations.
    device, chunk = torch.device("cpu"), max(1, 8 * _CHUNK // model.positions)
    count = max(1, min(torch.get_num_threads(), n // chunk))
    edges = [n * k // count for k in range(count + 1)]
    with ThreadPoolExecutor(count) as pool:
        return np.concatenate(list(pool.map(evaluate, edges[:-1], edges[1:])))


def _predict_natively(
    found: Kernel, model: NeuralMaterial, hints: Tensor | None, *arrays: ArrayLike
) -> NDArray[np.float32]:
    assert isinstance(model, Neumip)
    inputs = [np.ascontiguousarray(a, np.float32) for a in arrays]
    n = len(inputs[1])
    shapes = [(n, 2), (n,), (n, 3), (n, 3)]
    if [a.shape for a in inputs] != shapes:
        raise ValueError(f"queries of the shapes {[a.shape for a in inputs]}, not {shapes}")
    native = NativeModel(found, model)
    out = np.empty((n, 3), np.float32)
    read = list(inputs)
    if isinstance(model, Relief):
        given = model.hints(*map(torch.from_numpy, inputs)) if hints is None else hints
        read.append(np.ascontiguousarray(given.numpy()))

    def evaluate(start: int, stop: int) -> None:
        addresses = (a.ctypes.data + start * a.strides[0] for a in read)
        queries = QueryPointers(stop - start, *addresses)
        native.forward(queries, native.state(1), out.ctypes.data + start * out.strides[0], clamp=True)

    count = max(1, min(torch.get_num_threads(), n // _PER_THREAD))
    edges = [n * k // count for k in range(count + 1)]
    with ThreadPoolExecutor(count) as pool:
        list(pool.map(evaluate, edges[:-1], edges[1:]))
    if model.calibration is not None:
        out *= evaluate_in_chunks(model.calibration_factors, torch.device("cpu"), 3, *inputs[1:])
    return out

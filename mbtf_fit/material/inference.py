"""Evaluation of a model on NumPy arrays of any length."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_fit.backends.cpu.model import NativeModel, supports
from mbtf_fit.material.format import QUERY
from mbtf_fit.native import kernel
from mbtf_fit.native.library import QueryPointers
from mbtf_fit.pytorch.material import NeuralMaterial

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
    """Values (n, 3) of a material in 1/sr, clamped at 0. `hints` (n, 7) of its surface are computed where
    they are not given."""
    given = [tuple(np.shape(a)) for a in (u, sigma, omega_i, omega_o)]
    n = next(iter(given[1]), 0)
    if given != [(n, 2), (n,), (n, 3), (n, 3)]:
        what = f"have the shapes {', '.join(map(str, given))}"
        raise InputError(what, where=", ".join(QUERY), hint="they must be (n, 2), (n,), (n, 3) and (n, 3)")
    found = kernel()
    if found is not None and supports(model):
        return _predict_natively(NativeModel(found, model), hints, u, sigma, omega_i, omega_o)
    device = next(model.parameters()).device
    arrays = (u, sigma, omega_i, omega_o, *([] if hints is None else [hints.cpu()]))
    return evaluate_in_chunks(
        lambda *a: model(*a).clamp_min(0), device, 3, *arrays, chunk=max(1, _CHUNK // model.positions)
    )


def _predict_natively(native: NativeModel, hints: Tensor | None, *arrays: ArrayLike) -> NDArray[np.float32]:
    inputs = [np.ascontiguousarray(a, np.float32) for a in arrays]
    n = len(inputs[1])
    out = np.empty((n, 3), np.float32)
    read = list(inputs)
    if native.pattern.displace is not None:
        given = native.material.hints(*map(torch.from_numpy, inputs)) if hints is None else hints
        read.append(np.ascontiguousarray(given.numpy()))

    def evaluate(start: int, stop: int) -> None:
        addresses = (a.ctypes.data + start * a.strides[0] for a in read)
        queries = QueryPointers(stop - start, *addresses)
        native.forward(queries, native.state(1), out.ctypes.data + start * out.strides[0], clamp=True)

    count = max(1, min(torch.get_num_threads(), n // _PER_THREAD))
    edges = [n * k // count for k in range(count + 1)]
    with ThreadPoolExecutor(count) as pool:
        list(pool.map(evaluate, edges[:-1], edges[1:]))
    if native.pattern.factors:
        out *= evaluate_in_chunks(partial(_factors, native), torch.device("cpu"), 3, *inputs[1:])
    return out


def _factors(native: NativeModel, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
    """Product (n, 3) of the calibration factors."""
    given = {"level": native.material.level(sigma), "omega_i": omega_i, "omega_o": omega_o}
    first, *rest = native.material.run(native.pattern.factors, given)
    for factors in rest:
        first = first * factors
    return first

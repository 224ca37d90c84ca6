"""Queries for models that trace heights, and their gradients by the compiled kernel beside autograd."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mbtf_fit import FitConfig
from mbtf_fit.backends.cpu.gradients import NativeGradients
from mbtf_fit.backends.cpu.model import NativeModel, supports
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.native import library
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.objective.parallel import Workers
from mbtf_fit.pytorch.material import NeuralMaterial

from .fit_data import parallax, random_queries, training_queries

needs_kernel = pytest.mark.skipif(library.kernel() is None, reason=library.missing_reason() or "kernel")


def traced_batch(model: NeuralMaterial, n: int = 700) -> TrainingQueries:
    """Random queries all over the plane, with their hints."""
    arrays = random_queries(np.random.default_rng(0), n, model.lattice)
    arrays["u"] = (5 * arrays["u"] - 2).astype(np.float32)
    batch = training_queries(arrays, parallax(*arrays.values()))
    return replace(batch, hints=model.hints(batch.u, batch.sigma, batch.omega_i, batch.omega_o))


def assert_gradients_agree(model: NeuralMaterial, batch: TrainingQueries) -> None:
    """Loss, and its gradients by texels, heights, depth weights and all layers."""
    kernel = library.kernel()
    assert kernel is not None
    assert supports(model)
    objective = Objective(FitConfig().training, NoiseModel.silent(0.1, model.lattice))
    loss = objective(model(batch.u, batch.sigma, batch.omega_i, batch.omega_o, batch.hints), batch)
    texels, weights = model.parameter_groups()
    exact = torch.autograd.grad(loss, [*texels, *weights])
    gradients = NativeGradients(NativeModel(kernel, model))
    with Workers(torch.device("cpu")) as workers:
        native = gradients.compute(objective, batch, workers)
    assert float(native) == pytest.approx(float(loss.detach()), rel=1e-5)
    names = [name for name, _ in model.named_parameters() if not name.endswith("texels")]
    layers, levels = iter(gradients.networks[0]), model.lattice.finest + 1
    mine = [gradients.depth_weights[:levels] if name == "depth_weights" else next(layers) for name in names]
    labels = ["texels", "heights"][: len(gradients.textures)] + names
    for label, a, b in zip(labels, exact, [*gradients.textures, *mine], strict=True):
        assert float(a.abs().max()) > 0, label
        assert float((a - b).abs().max()) < 1e-4 * float(a.abs().max()), label

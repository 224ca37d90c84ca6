"""Training on a GPU: the device without numbers, which refuses tensors of other devices, stands for it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.fit_data import random_queries
from support.known_surfaces import rough_surface
from support.slice_data import prepared
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_fit.config import FitConfig, build_model
from mbtf_fit.data.layouts import Patches, SliceBatch, TrainingSlices
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.models.registry import MODELS
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.ops.constants import KNOTS
from mbtf_fit.pytorch.textures import FeatureTextures
from mbtf_fit.surface import heightfield
from mbtf_gen.sampling.query_sampler import slice_directions

LATTICE, META = Lattice(3), torch.device("meta")


@pytest.fixture(autouse=True)
def no_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without numbers no ray arrives; its table must be where the rays are."""

    def trace(cells: Tensor, aspect: float, u: Tensor, omega: Tensor) -> Tensor:
        return (cells[0, 0, 0] + u[:, 0] * omega[:, 0]) * 0

    monkeypatch.setattr(heightfield, "trace_reference", trace)


def batch(model: str, margin: int, n: int = 12) -> TrainingQueries | Patches:
    """Queries without values."""
    arrays = random_queries(np.random.default_rng(0), n, LATTICE)
    u, sigma, light, view = (torch.from_numpy(a).to(META) for a in arrays.values())
    if MODELS[model].layout == "shuffled":
        return TrainingQueries(u, sigma, light, view, torch.zeros(n, 3, device=META))
    wide = 4 + 2 * margin
    positions, values = (torch.zeros(n, k, k, c, device=META) for k, c in ((wide, 2), (4, 3)))
    return Patches(positions, sigma, light, view, values)


# Slices have a test of their own below.
@pytest.mark.parametrize("name", [name for name in MODELS if MODELS[name].layout != "slices"])
def test_loss_and_gradients_stay_on_the_device(name: str) -> None:
    model = build_model(name, LATTICE)
    if model.tracing is not None:
        model.know(rough_surface(LATTICE))
    model.initialize(torch.Generator().manual_seed(0), 0.1)
    model.to(META)
    if MODELS[name].calibrates:
        model.calibrate(torch.ones(2, LATTICE.finest + 1, KNOTS, 3, device=META))
    for texture in model.textures():
        texture.read(texture.blurred(1.5))
    queries = batch(name, model.margin)
    config = FitConfig.model_validate({"model": name})
    objective = Objective(config.training, NoiseModel.silent(0.1, LATTICE))
    loss = objective(*MODELS[name](model).predict(queries))
    texels, weights = model.parameter_groups()
    gradients = torch.autograd.grad(loss, [*texels, *weights])
    assert {g.device for g in gradients} == {META}


@pytest.mark.parametrize("name", [name for name in MODELS if MODELS[name].layout == "slices"])
def test_slices_stay_on_the_device(name: str) -> None:
    material = build_model(name, LATTICE)
    material.initialize(torch.Generator().manual_seed(0), 0.1)
    model = prepared(material.to(META), name, 9, META)
    omega = torch.from_numpy(slice_directions("spiral", 9, 0.2)).to(META)
    slices = TrainingSlices(torch.ones(LATTICE.texels(), 9, 3, device=META), omega, omega, 0.1)
    chosen, read = torch.zeros(4, 9, dtype=torch.int64, device=META), torch.arange(9, device=META)
    batch = SliceBatch(slices.values[:4], omega, omega, chosen, read, 0.1)
    config = FitConfig.model_validate({"model": name})
    objective = Objective(config.training, NoiseModel.silent(0.1, LATTICE))
    loss = objective(*model.predict(batch))
    gradients = torch.autograd.grad(loss, model.trained()[1])
    assert {g.device for g in gradients} == {META}
    model.write_textures(slices)
    assert material.pyramid.texels.device == META


def test_levels_as_sums_stay_on_the_device() -> None:
    texture = FeatureTextures(LATTICE, range(LATTICE.finest + 1), 3).to(META)
    texture.make_residual()
    assert texture.blurred(1.5).device == META

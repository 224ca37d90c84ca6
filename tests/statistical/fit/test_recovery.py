"""Fits recover known data: those of a model itself, a homogeneous BRDF, planes below the reference plane."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.fit_data import F32, parallax, random_queries, write_data

from mbtf_core.data.lattice import Lattice
from mbtf_fit import FitConfig, FitResult, fit
from mbtf_fit.config import build_model
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.training.loop import TrainingLoop
from mbtf_fit.training.trainer import Trainer

LATTICE = Lattice(2)


def teacher() -> NeuralMaterial:
    model = build_model("neumip", LATTICE)
    generator = torch.Generator().manual_seed(1)
    model.initialize(generator, 0.1)
    for texture in model.textures():
        torch.nn.init.normal_(texture.texels, 0.0, 0.5, generator=generator)
    # Values are positive on average, as those of materials are: exp(x) - 1 in negative units could not rise.
    with torch.no_grad():
        list(model.decoder.parameters())[-1].fill_(1.0)
    return model


def answers(model: NeuralMaterial, n: int, seed: int) -> TrainingQueries:
    arrays = random_queries(np.random.default_rng(seed), n, LATTICE)
    tensors = [torch.from_numpy(a) for a in arrays.values()]
    with torch.no_grad():
        return TrainingQueries(*tensors, model(*tensors))


def trainer(model: NeuralMaterial, data: TrainingQueries, **training: Any) -> Trainer:
    blur = {"initial_sigma": 0, "offset_sigma": 0}
    options = {"losses": [{"kind": "squared"}], "huber_delta": None, "warmup": 20, "blur": blur, **training}
    config = FitConfig.model_validate({"model": "neumip", "training": options})
    return Trainer(config, model, data, NoiseModel.silent(0.02, LATTICE))


def finish(t: Trainer) -> None:
    while not TrainingLoop([t]).train(60.0):
        pass
    for texture in t.model.textures():
        texture.read(None)


def relative_error(model: NeuralMaterial, data: TrainingQueries) -> float:
    """Root of the mean squared error over the mean square."""
    with torch.no_grad():
        found = model(data.u, data.sigma, data.omega_i, data.omega_o)
    return float((found - data.value).square().mean() / data.value.square().mean()) ** 0.5


@pytest.mark.parametrize(
    ("queries", "steps", "bound"),
    [(12_000, 250, 3e-3), pytest.param(60_000, 4000, 1e-4, marks=[pytest.mark.slow])],
)
def test_perturbed_parameters_are_recovered(queries: int, steps: int, bound: float) -> None:
    data, unseen = answers(teacher(), queries, 0), answers(teacher(), 5000, 9)
    model = teacher()
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for p in model.parameters():
            p.add_(0.03 * p.std(correction=0) * torch.randn(p.shape, generator=generator))
    before = relative_error(model, unseen)
    rates = {"learning_rate": 2e-3, "texture_learning_rate": 2e-3, "final_learning_rate_factor": 1e-4}
    finish(trainer(model, data, steps=steps, batch=2000, **rates))
    assert before > 5 * bound
    assert relative_error(model, unseen) < bound


WIDE = {"width": 64, "channels": 16}


@pytest.mark.parametrize(
    ("network", "queries", "steps", "rate", "bound"),
    [
        ({}, 60_000, 150, 3e-2, 0.12),
        pytest.param({}, 60_000, 3000, 3e-2, 0.033, marks=[pytest.mark.slow]),
        pytest.param(WIDE, 200_000, 8000, 1e-2, 0.01, marks=[pytest.mark.slow]),
    ],
)
def test_random_initializations_approach_the_true_values(
    network: dict[str, int], queries: int, steps: int, rate: float, bound: float
) -> None:
    """The bound applies to the squared error over the variance of the values."""
    data, unseen = answers(teacher(), queries, 0), answers(teacher(), 5000, 9)
    model = build_model("neumip", LATTICE, **network)
    model.initialize(torch.Generator().manual_seed(7), float(data.value.mean()))
    final = 1e-3 if rate > 1e-2 else 1e-4
    options = {"batch": 2000, "texture_learning_rate": 1e-2, "final_learning_rate_factor": final}
    finish(trainer(model, data, steps=steps, learning_rate=rate, **options))
    variance = (unseen.value - unseen.value.mean()).square().mean()
    share = relative_error(model, unseen) ** 2 * float(unseen.value.square().mean() / variance)
    assert share < bound


def glossy(u: F32, sigma: F32, omega_i: F32, omega_o: F32) -> NDArray[np.float64]:
    """A homogeneous BRDF with a broad lobe."""
    half = omega_i.astype(np.float64) + omega_o
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    return (0.1 + 0.3 * half[:, 2:] ** 40) * np.array([1.0, 0.7, 0.4])


def test_a_homogeneous_brdf_is_fitted_to_the_noise_floor(tmp_path: Path) -> None:
    """With noise of variance s² in N values, the error of a fit of P parameters is about s² P/N."""
    noise, train = 0.1, 40_000
    folder = write_data(tmp_path / "d", glossy, train=train, test=10_000, noise=noise)
    options = {"steps": 300, "batch": 4000, "warmup": 20}
    result = fit(FitConfig.model_validate({"model": "neumip", "training": options}), folder, tmp_path / "m")
    test = result.errors["test"]
    parameters = result.material.description["weights"]["network_weights"]
    # The noise of the mean of both halves, times the share that so many parameters can follow.
    floor = noise**2 / 2 * parameters / train
    assert test["mse"]["value"] < floor + 4 * test["mse"]["error"]
    assert test["mse"]["value"] < 0.1 * noise**2 / 2
    assert test["unexplained"]["value"] < 0.1


def sunk_plane(u: F32, sigma: F32, omega_i: F32, omega_o: F32) -> NDArray[np.float64]:
    """A texture on a plane 0.04 tile widths below the reference plane, for all lights and footprints."""
    at = u.astype(np.float64) - DEPTH * omega_o[:, :2] / omega_o[:, 2:]
    value = np.full((len(u), 3), 0.2)
    for k, (i, j, phase) in enumerate(WAVES):
        fade = np.exp(-2 * (np.pi * sigma) ** 2 * (i * i + j * j))
        value[:, k % 3] += 0.05 * fade * np.cos(2 * np.pi * (i * at[:, 0] + j * at[:, 1]) + phase)
    return value


DEPTH = 0.04
WAVES = [(1, 0, 0.3), (0, 1, 1.0), (1, 1, 2.0), (2, -1, 0.5), (1, 2, 4.0), (-1, 2, 5.0), (3, 1, 0.0)]
WAVES += [(1, -3, 1.5)]


def test_the_offset_of_a_sunk_plane_is_its_depth(tmp_path: Path) -> None:
    """The learned offset is ``-d ω_o,xy / ω_o,z`` within 5%."""
    folder = write_data(tmp_path / "d", sunk_plane, train=60_000, test=1000, finest=4, noise=0.01)
    options = {"steps": 500, "batch": 4000, "warmup": 20, "losses": [{"kind": "squared"}]}
    result = fit(FitConfig.model_validate({"model": "neumip", "training": options}), folder, tmp_path / "m")
    assert result.errors["test"]["unexplained"]["value"] < 0.05
    queries = random_queries(np.random.default_rng(7), 5000, Lattice(4))
    u, view = queries["u"], queries["omega_o"]
    found = result.material.offset(u, view)
    true = -DEPTH * view[:, :2] / view[:, 2:]
    # The model divides by max(ω_o,z, 0.6): what is below that it must learn as a function of the view.
    for steep, bound in ((view[:, 2] > 0.6, 0.1), (view[:, 2] <= 0.6, 0.3)):
        slope = (found[steep] * true[steep]).sum() / (true[steep] ** 2).sum()
        scatter = np.sqrt(((found[steep] - true[steep]) ** 2).sum() / (true[steep] ** 2).sum())
        assert slope == pytest.approx(1.0, abs=0.05)
        assert scatter < bound


@pytest.fixture(scope="module")
def fits(tmp_path_factory: pytest.TempPathFactory) -> dict[str, FitResult]:
    folder = tmp_path_factory.mktemp("parallax")
    shards = write_data(folder / "shards", parallax, train=60_000, test=20_000, finest=4, noise=0.03)
    options = {"steps": 400, "batch": 4000, "warmup": 20}
    return {
        model: fit(FitConfig.model_validate({"model": model, "training": options}), shards, folder / model)
        for model in ("neumip", "neumip-baseline")
    }


def test_the_offset_explains_what_the_baseline_cannot(fits: dict[str, FitResult]) -> None:
    found = {model: result.errors["test"]["unexplained"] for model, result in fits.items()}
    for estimate in found.values():
        assert estimate["error"] < 0.02
    assert found["neumip"]["value"] < 0.07
    assert found["neumip-baseline"]["value"] > 2 * found["neumip"]["value"]


@pytest.mark.parametrize("model", ["neumip", "neumip-baseline"])
def test_directions_never_trained_on_are_predicted(fits: dict[str, FitResult], model: str) -> None:
    errors = fits[model].errors
    seen, unseen = (errors[k]["mse"] for k in ("held_out_queries", "held_out_directions"))
    # The function is smooth: a hole of a tenth of the disk's radius costs little.
    assert unseen["value"] < 2 * seen["value"] + 4 * (unseen["error"] + seen["error"])

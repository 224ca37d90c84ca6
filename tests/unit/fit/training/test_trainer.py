"""Training: batches, schedules, gradients of several threads, resuming."""

from __future__ import annotations

from dataclasses import astuple, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.fit_data import make_trainer, parallax, random_queries, train_fully, training_queries, write_data

import mbtf_fit.training.trainer
from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit.config import FitConfig, ModelName, build_model
from mbtf_fit.data.loader import load_training
from mbtf_fit.data.queries import ShardQueries, TrainingQueries
from mbtf_fit.native import kernel
from mbtf_fit.objective.parallel import Workers
from mbtf_fit.sections import TrainingSection
from mbtf_fit.training.suitable_data import open_data
from mbtf_fit.training.trainer import (
    Regularization,
    Trainer,
    learning_rate_factor,
    prepare_trainer,
)

LATTICE = Lattice(3)


def queries(n: int = 5000) -> TrainingQueries:
    arrays = random_queries(np.random.default_rng(0), n, LATTICE)
    return training_queries(arrays, parallax(*arrays.values()))


@pytest.fixture(params=[True, False], ids=["compiled", "PyTorch"])
def with_and_without_the_kernel(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if not request.param:
        monkeypatch.setattr(mbtf_fit.training.trainer, "kernel", lambda: None)


def trainer(data: TrainingQueries, model: str = "neumip", **training: Any) -> Trainer:
    return make_trainer(data, LATTICE, model, **{"steps": 40, "batch": 1000, "warmup": 5, **training})


@pytest.mark.parametrize(("shape", "asked", "start"), [((64, 16), 8, 2), ((64, 64), 3, 3), ((16, 16), 0, 0)])
def test_initial_blur_is_at_most_an_eighth(shape: tuple[int, int], asked: float, start: float) -> None:
    """Wider blur leaves nothing to find: offsets wander off and textures become sharp where they are."""
    blur = {"initial_sigma": asked, "final_sigma": 0.25, "offset_sigma": 0.5}
    t = make_trainer(queries(500), Lattice.for_map(*shape), "neumip", steps=40, batch=100, blur=blur)
    assert t._sigmas() == [max(start, 0.5) if x.moves_lookups else start for x in t.model.textures()]


@pytest.mark.parametrize(("model", "trained"), [("neumip", 5), ("quartesan2022", 2)])
def test_levels_that_no_lookup_of_the_data_reads_are_averages(model: str, trained: int) -> None:
    """Of data with the footprint of level 5; `quartesan2022` reads the three coarser ones beside it."""
    t = make_trainer(queries(500), Lattice(5), model, steps=40, batch=100)
    pyramid = t.model.textures()[0]
    before = pyramid.export()
    t.fill_levels(5.0)
    for level, texels in pyramid.export().items():
        if int(level) >= trained:
            assert torch.equal(texels, before[level])
        else:
            size = 2 ** (trained - int(level))
            blocks = before[str(trained)].unfold(0, size, size).unfold(1, size, size)
            torch.testing.assert_close(texels, blocks.mean((-2, -1)))


def test_filling_levels_keeps_those_that_are_read_where_levels_are_sums() -> None:
    t = make_trainer(
        *(queries(500), Lattice(5, 0.7), "neumip"),
        **{"steps": 40, "batch": 100, "residual_levels": True, "blur": {"min_sigma": 1.6}},
    )
    pyramid = t.model.textures()[0]
    torch.nn.init.normal_(pyramid.texels, generator=torch.Generator().manual_seed(1))
    t._read_blurred()
    before = pyramid.export()["5"]
    t.fill_levels(5.0)
    t._read_blurred()
    after = pyramid.export()
    assert torch.equal(after["5"], before)
    torch.testing.assert_close(after["0"].mean((0, 1)), before.mean((0, 1)))


@pytest.mark.skipif(kernel() is None, reason="needs the compiled kernel")
@pytest.mark.parametrize("blur", [{"min_sigma": 1.6}, {"initial_sigma": 0.0, "offset_sigma": 0.0}])
def test_steps_of_residual_levels_are_those_of_pytorch(
    blur: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Processors with bfloat16 tiles would round factors of PyTorch's products to 8 bits.
    monkeypatch.setattr(torch, "set_float32_matmul_precision", lambda precision: None)
    found = []
    for used in (kernel(), None):
        monkeypatch.setattr(mbtf_fit.training.trainer, "kernel", lambda used=used: used)
        t = make_trainer(
            *(queries(2000), Lattice(3, 0.7), "neumip"),
            **{"steps": 40, "batch": 500, "residual_levels": True, "blur": blur},
        )
        assert t.backend.startswith("pytorch" if used is None else "kernel")
        assert t.model.textures()[0].residual
        residuals = t.model.textures()[0].texels
        start = residuals.detach().clone()
        with Workers(torch.device("cpu"), 2) as workers:
            steps = t.steps(workers, 0)
            for _ in range(3):
                next(steps)
                t.progress.step += 1
        moment = t.optimizer.state[residuals]["exp_avg"]
        # Every level learns, the coarsest from the queries of all.
        starts = t.model.textures()[0].packing.starts
        assert all(bool(moment[a:b].any()) for a, b in pairwise(starts))
        found.append((residuals.detach() - start, moment.clone()))
    for mine, reference in zip(*found, strict=True):
        assert float((mine - reference).norm()) < 1e-4 * float(reference.norm())
    # As sums, levels start where independent ones do.
    plain = make_trainer(queries(2000), Lattice(3, 0.7), "neumip", steps=40, batch=500)
    pyramid, expected = t.model.textures()[0], plain.model.textures()[0].texels.detach()
    with torch.no_grad():
        pyramid.texels.copy_(start)
    torch.testing.assert_close(pyramid.blurred(0.0).detach(), expected, atol=1e-5, rtol=0)


def test_threads_share_a_batch_without_changing_its_gradient() -> None:
    data = queries(999)
    t = trainer(data)
    inputs = list(t.model.parameters())
    found = []
    for threads in (1, 3):
        with Workers(torch.device("cpu"), threads) as workers:
            assert workers.count == threads
            found.append(workers.gradients(t._loss, data, inputs))
    torch.testing.assert_close(found[0][0], found[1][0])
    for one, three in zip(found[0][1], found[1][1], strict=True):
        torch.testing.assert_close(one, three, rtol=1e-4, atol=1e-6)


def test_rates_rise_and_fall() -> None:
    training = FitConfig().training.model_copy(update={"warmup": 10, "final_learning_rate_factor": 0.05})
    assert learning_rate_factor(training, 0, 0.0) == pytest.approx(1 / 11)
    assert learning_rate_factor(training, 10, 0.0) == 1.0
    # In a fit of 20 steps, the warm-up takes four.
    assert learning_rate_factor(training, 2, 0.1) == pytest.approx(0.5, abs=0.02)
    assert learning_rate_factor(training, 4, 0.2) == pytest.approx(0.91, abs=0.01)
    assert learning_rate_factor(training, 1000, 0.5) == pytest.approx(0.525)
    assert learning_rate_factor(training, 1000, 1.0) == pytest.approx(0.05)


@pytest.mark.usefixtures("with_and_without_the_kernel")
def test_textures_and_networks_learn_at_their_own_rates() -> None:
    """The first step of Adam is as long as the rate, whatever the gradient."""
    rates = {"texture_learning_rate": 1e-3, "learning_rate": 1e-4, "warmup": 0}
    t = trainer(queries(), steps=1, blur={"initial_sigma": 0.0, "offset_sigma": 0.0}, **rates)
    groups = t.model.parameter_groups()
    before = [[p.detach().clone() for p in group] for group in groups]
    train_fully(t)
    for group, old, rate in zip(groups, before, (1e-3, 1e-4), strict=True):
        longest = max(float((p.detach() - q).abs().max()) for p, q in zip(group, old, strict=True))
        assert longest == pytest.approx(rate, rel=0.01)


@pytest.mark.usefixtures("with_and_without_the_kernel")
def test_texels_without_a_gradient_decay_with_the_rate() -> None:
    arrays = random_queries(np.random.default_rng(0), 64, LATTICE)
    arrays["sigma"][:] = 0.5
    data = training_queries(arrays, parallax(*arrays.values()))
    rates = {"texture_learning_rate": 0.05, "warmup": 0, "final_learning_rate_factor": 0.1}
    t = trainer(data, steps=5, texture_weight_decay=2.0, blur={"initial_sigma": 0.0}, **rates)
    first = t.model.textures()[0].texels.detach().clone()
    rates = [0.05 * learning_rate_factor(t.config.training, k, k / 5) for k in range(5)]
    train_fully(t)
    finest = t.model.textures()[0].packing.starts[-2]
    expected = first[finest:] * np.exp(-2.0 * sum(rates))
    torch.testing.assert_close(t.model.textures()[0].texels.detach()[finest:], expected)


def test_a_time_budget_takes_its_fewest_steps() -> None:
    """Schedules follow whichever is behind, so that they end with the training."""
    t = trainer(queries(), steps=None, time="0.001s, at least 4 steps")
    fractions = []
    step = t._step

    def recorded(*arguments: Any) -> torch.Tensor:
        fractions.append(t.fraction)
        return step(*arguments)

    t._step = recorded  # type: ignore[method-assign]
    train_fully(t)
    assert fractions == [0.0, 0.25, 0.5, 0.75]
    assert trainer(queries(), steps=None, time="1h, at least 1 steps").fraction == 0.0


def test_each_texture_keeps_its_least_blur() -> None:
    t = train_fully(trainer(queries(), blur={"min_sigma": 0.7, "offset_sigma": 0.3}))
    pyramid, offset = t.model.textures()
    for found, expected in zip(t._tables(), (pyramid.blurred(0.7), offset.blurred(0.3)), strict=True):
        torch.testing.assert_close(found, expected)
    # Materials hold what is read, blur included.
    value = queries(10).value.numpy()
    arrays = random_queries(np.random.default_rng(0), 10, LATTICE)
    t.predict(ShardQueries(**arrays, value_a=value, value_b=value))
    torch.testing.assert_close(pyramid.export()["3"].reshape(64, -1), pyramid.blurred(0.7)[-64:].detach())


@pytest.mark.usefixtures("with_and_without_the_kernel")
@pytest.mark.parametrize("poison", ["pyramid.texels", "offset_texture.texels", "offset_network.3.bias"])
def test_divergence_is_one_error_with_a_hint(poison: str) -> None:
    t = trainer(queries())
    with torch.no_grad():
        t.model.get_parameter(poison).fill_(torch.nan)
    with pytest.raises(InputError, match=r"diverged at step 1: its batch .*\n.*--learning-rate 0\.01 "):
        train_fully(t)


def test_weights_that_diverge_in_the_last_step_are_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its loss was that of the weights before, and finite."""
    step = Trainer._step

    def spoiling(self: Trainer, *arguments: Any) -> torch.Tensor:
        loss = step(self, *arguments)
        if self.progress.step == 2:
            with torch.no_grad():
                self.model.parameter_groups()[1][0].fill_(torch.inf)
        assert bool(loss.isfinite())
        return loss

    monkeypatch.setattr(Trainer, "_step", spoiling)
    with pytest.raises(InputError, match="diverged at step 3"):
        train_fully(trainer(queries(), steps=3))


@pytest.mark.parametrize(
    ("ratio", "queries", "strength", "expected"),
    [
        (0.0, 400_000, 1.0, (2.0, 0.0, 0.0, 0.0)),
        (0.4, 400_000, 1.0, (2.75, 0.16, 0.0072, 0.3535534)),
        (2.0, 100_000, 1.0, (17.0, 1.0, 0.18, 1.581139)),
        (2.0, 100_000, 0.1, (3.5, 0.4, 0.018, 0.5)),
        (5.0, 10_000, 1.0, (52.0, 1.0, 1.0, 7.905694)),
    ],
)
def test_noise_per_query_increases_regularization(
    ratio: float, queries: int, strength: float, expected: tuple[float, ...]
) -> None:
    """Decay of texels, and the area of their blur, grow with the noise ratio over the queries per texel;
    decay of weights with its square up to a ratio of a half, then with it, over the number of queries; there
    is a limit, or few queries would decay everything to 0."""
    options = {"texture_weight_decay": 2.0, "noise_regularization": strength}
    found = Regularization.of(TrainingSection.model_validate(options), ratio, queries, texels=5000)
    assert astuple(found) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("model", "network", "columns"),
    [
        ("neumip", {}, {"decoder.0.weight": [*range(7)], "offset_network.0.weight": [*range(7)]}),
        ("quartesan2022", {"offset": "none"}, {"decoder.0.weight": [*range(16)]}),
        ("relief", {}, {"decoder.0.weight": [*range(8), *range(20, 32)]}),
        ("hierarchical", {"offset": "none"}, {"decoder.first.weight": [*range(47)]}),
    ],
)
def test_weights_of_the_position_decay_more_and_biases_not(
    model: ModelName, network: dict[str, Any], columns: dict[str, list[int]]
) -> None:
    found = build_model(model, LATTICE, **network)
    with torch.no_grad():
        for p in found.parameters():
            p.fill_(1.0)
    decay = Regularization(texels=3.0, spatial_weights=20.0, weights=2.0, min_sigma=0.0)
    decay.decay(found, 0.1, 0.01)
    texels, _ = found.parameter_groups()
    for name, p in found.named_parameters():
        expected = torch.ones_like(p)
        if any(p is t for t in texels):
            expected *= np.exp(-0.3)
        elif p.ndim > 1:
            expected *= np.exp(-0.02)
            expected[:, columns.get(name, [])] *= np.exp(-0.2)
        torch.testing.assert_close(p.detach(), expected)


def test_texels_without_a_network_are_not_regularized() -> None:
    t = trainer(queries(), "svbrdf")
    noisy = Trainer(t.config, t.model, t.queries, replace(t.noise, ratio=5.0))
    assert noisy.regularization.texels == 0.0


def test_a_fit_estimates_the_noise_ratio_of_its_data(tmp_path: Path) -> None:
    """Noise of 0.02 in each half is 2e-4 of variance in their mean."""
    folder = write_data(tmp_path / "data", parallax, train=20_000, noise=0.02)
    training = {"steps": 9, "noise_regularization": 0.005, "texture_weight_decay": 1.0}
    config = FitConfig.model_validate({"model": "neumip", "training": training})
    data = open_data(folder, "neumip")
    partition = load_training(data, config.held_out, config.seed, config.data.memory)
    trainer = prepare_trainer(config, data, partition, torch.device("cpu"))
    arrays = random_queries(np.random.default_rng(5), 20_000, LATTICE)
    ratio = 2e-4 / parallax(*arrays.values()).var(0).mean()
    assert ratio > 0.5
    n = len(partition.training)
    texels = len(trainer.model.textures()[0].texels)
    expected = Regularization.of(config.training, ratio, n, texels)
    assert astuple(trainer.regularization) == pytest.approx(astuple(expected), rel=0.1)

"""A fit that overfits ends with its best state; others end with their last one."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.fit_data import parallax, random_queries, write_data
from support.killed_fits import Killed, kill_in

import mbtf_fit.training.fit as fits
import mbtf_fit.training.loop as loop
import mbtf_fit.training.trainer as trainers
from mbtf_core.data.lattice import Lattice
from mbtf_fit.config import FitConfig, build_model
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.ops import Transform
from mbtf_fit.pytorch.operations import PYTORCH, Execution
from mbtf_fit.training.best_state import excess_error, overfits
from mbtf_fit.training.endings import describe_kept
from mbtf_fit.training.fit import FitResult, fit
from mbtf_fit.training.trainer import Trainer

STEPS, BEST = 8, 3
NOISE = 0.05


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data") / "shards", parallax, train=2000, test=300, noise=0.02)


def config(**training: Any) -> FitConfig:
    options = {"steps": STEPS, "batch": 200, "warmup": 0, "energy_calibration": False, **training}
    return FitConfig.model_validate({"model": "neumip", "training": options})


@pytest.fixture
def weights_at(monkeypatch: pytest.MonkeyPatch) -> dict[int, dict[str, torch.Tensor]]:
    """Weights by step. Validation and checkpoint follow each step; the error of predictions is least after
    step 3."""
    seen: dict[int, dict[str, torch.Tensor]] = {}

    def predict(trainer: Trainer, queries: ShardQueries) -> NDArray[np.float32]:
        # The first one counts: the errors of the kept state are evaluated at its step.
        seen.setdefault(
            trainer.progress.step, {n: p.detach().clone() for n, p in trainer.parameters().items()}
        )
        excess = 0.1 * abs(trainer.progress.step - BEST)
        return (0.5 * (queries.value_a + queries.value_b) * (1.0 + excess)).astype(np.float32)

    monkeypatch.setattr(Trainer, "predict", predict)
    monkeypatch.setattr(loop, "is_candidate", lambda step: True)
    monkeypatch.setattr(fits, "_CHECKPOINT_SECONDS", 0.0)
    return seen


def check_kept(found: FitResult, weights: dict[str, torch.Tensor]) -> None:
    training = found.material.description["training"]
    assert (training["steps"], training["kept_step"], found.kept_step) == (STEPS, BEST, BEST)
    assert found.history[-1]["step"] == STEPS
    mine = dict(found.material.model.named_parameters())
    # The networks are exported as they are, textures with their blur.
    networks = [name for name in mine if name.startswith("decoder")]
    assert networks
    assert all(torch.equal(mine[name], weights[name]) for name in networks)
    # Errors are those of the kept state.
    assert found.errors["test"]["mse"]["value"] < 0.01 * found.errors["test"]["variance"]["value"]


def test_a_fit_that_overfits_returns_to_its_best_state(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights_at: dict[int, Any]
) -> None:
    """Also one that is killed after its best step, whose checkpoint has both states."""
    predicted, predict = Counter[int](), Trainer.predict

    def counted(trainer: Trainer, queries: ShardQueries) -> NDArray[np.float32]:
        predicted[trainer.progress.step] += 1
        return predict(trainer, queries)

    monkeypatch.setattr(Trainer, "predict", counted)
    found = fit(config(), shards, tmp_path / "whole")
    check_kept(found, weights_at[BEST])
    # Its last validation also decides which state is kept.
    assert predicted[STEPS] == 1
    assert not torch.equal(weights_at[BEST]["decoder.0.weight"], weights_at[STEPS]["decoder.0.weight"])
    line = str(describe_kept(found.history, found.kept_step))
    assert line.startswith("validation error rose from ")
    assert f"after {STEPS}: kept the state after {BEST} steps" in line

    with monkeypatch.context() as patch:
        kill_in(patch, {STEPS - 1})
        with pytest.raises(Killed):
            fit(config(), shards, tmp_path / "killed")
    resumed = fit(config(), shards, tmp_path / "killed")
    assert resumed.resumed
    check_kept(resumed, weights_at[BEST])
    mine, other = resumed.material.model.weights(), found.material.model.weights()
    assert all(torch.equal(mine[name], other[name]) for name in other)


@pytest.mark.parametrize("seconds", [0.0, 1e9])
def test_the_choice_does_not_depend_on_the_speed_of_the_machine(
    seconds: float, shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights_at: dict[int, Any]
) -> None:
    """Reports between candidates, here the even steps, choose nothing."""
    monkeypatch.setattr(loop, "is_candidate", lambda step: step % 2 == 0)
    monkeypatch.setattr(fits, "_REPORT_SECONDS", seconds)
    assert fit(config(), shards, tmp_path / "m").kept_step == BEST + 1


def test_a_fit_lowers_the_bound_of_its_values_where_glints_are_false(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One prediction in 30 is as bright as the bound, which ends at the least that is tried above 10."""
    bounds: list[float] = []

    def predict(trainer: Trainer, queries: ShardQueries) -> NDArray[np.float32]:
        bounds.append(float(trainer.model.number("most")))
        glint = np.where(np.arange(len(queries)) % 30 == 0, bounds[-1], 0.0)[:, None]
        return np.float32(0.5 * (queries.value_a + queries.value_b) + glint)

    monkeypatch.setattr(Trainer, "predict", predict)
    monkeypatch.setattr(trainers, "value_bound", lambda values, unit: 300.0)
    found = fit(config(), shards, tmp_path / "m")
    # Validations alone predict at the first bound.
    assert bounds.count(300.0) == len(found.history)
    assert float(found.material.model.number("most")) == pytest.approx(300.0 / 4**2)


@pytest.mark.parametrize(("by_value", "by_x"), [(1.0, math.exp(3.0)), (-1.0, 0.0)])
def test_training_never_raises_values_beyond_their_bound(by_value: float, by_x: float) -> None:
    model = build_model("neumip-baseline", Lattice(3))
    model.number("most").fill_(2.0)
    x = torch.tensor([[3.0, 3.0, 0.5]], requires_grad=True)
    op = next(op for op in model.operations if isinstance(op, Transform) and op.most is not None)
    value = PYTORCH[op](op, Execution(model), x)
    assert value.detach().tolist() == [[2.0, 2.0, pytest.approx(math.expm1(0.5))]]
    (by_value * value.sum()).backward()
    assert x.grad is not None
    assert x.grad.tolist()[0] == pytest.approx([by_x, by_x, by_value * math.exp(0.5)])


def test_the_excess_is_paired_and_relative_to_the_variance() -> None:
    """Of a prediction that is off by a constant, over one that is off by half of it; noise of the reference
    hides neither."""
    random = np.random.default_rng(0)
    arrays = random_queries(random, 4000, Lattice(3))
    true = parallax(*arrays.values())
    a, b = (true + random.normal(0.0, NOISE, true.shape) for _ in range(2))
    queries = ShardQueries(*arrays.values(), a.astype(np.float32), b.astype(np.float32))
    near, far = (np.float32(true + offset) for offset in (0.005, 0.01))
    expected = (0.01**2 - 0.005**2) / true.var(0).mean()
    found = excess_error([far], [near], [queries])
    assert abs(found.value - expected) < 4 * found.error
    assert found.value > 3 * found.error
    # Significant differences below a twentieth of the error do not count.
    for offset, worse in ((0.0101, False), (0.0105, True)):
        assert overfits([np.float32(true + offset)], [far], [queries]) is worse
    # A glint is not significant, but worse than the mean value; a dimmer one is not.
    glint = near.copy()
    for brightness, worse in ((1.5, True), (0.5, False)):
        glint[0] = near[0] + brightness * math.sqrt(len(true) * true.var(0).mean())
        assert excess_error([glint], [near], [queries]).error > 0.3 * brightness**2
        assert overfits([glint], [near], [queries]) is worse
    # Two materials of other units, of which one is worse and one as much better.
    other = replace(queries, value_a=7 * queries.value_a, value_b=7 * queries.value_b)
    both = excess_error([far, 7 * near], [near, 7 * far], [queries, other])
    assert abs(both.value) < 1e-3 * expected
    assert both.error == pytest.approx(found.error * 2**0.5, rel=1e-3)

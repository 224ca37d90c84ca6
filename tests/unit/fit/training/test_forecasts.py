"""Forecasts of fits, which write nothing; validations; an error that ends training."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.fit_data import parallax, write_data

import mbtf_fit.training.fit as fits
import mbtf_fit.training.forecast as module
import mbtf_fit.training.validation as validation
from mbtf_core.stats import Estimate, signal_variance
from mbtf_fit import fit
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import load_training
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.sections import HeldOutSection
from mbtf_fit.training.endings import reached
from mbtf_fit.training.forecast import forecast_fit
from mbtf_fit.training.loop import TrainingLoop
from mbtf_fit.training.suitable_data import open_data
from mbtf_fit.training.trainer import Trainer
from mbtf_fit.training.validation import validation_set

STEPS = 4000
# Error that repeated queries add.
ADDED = 0.1


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data") / "shards", parallax, train=20000, noise=0.01)


def config(**training: object) -> FitConfig:
    return FitConfig.model_validate({"model": "neumip", "training": {"batch": 200, "warmup": 3, **training}})


@pytest.fixture
def law(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """(steps, queries) of pilots, which do not train: their errors are a law of the steps, more by `ADDED`
    where queries are repeated. One of fifty test queries has all of the error. Each pilot starts anew, and is
    calibrated."""
    pilots: list[tuple[int, int]] = []

    def predict(trainer: Trainer, queries: ShardQueries) -> NDArray[np.float64]:
        assert trainer.progress.step == 0
        assert trainer.model.calibration is not None
        steps = trainer.config.training.steps
        assert steps is not None
        repeated = len(trainer.queries) < pilots[0][1] if pilots else False
        pilots.append((steps, len(trainer.queries)))
        a, b = queries.value_a.astype(float), queries.value_b
        error = (0.03 + 3.0 * steps**-0.7 + ADDED * repeated) * signal_variance(a, b).value
        squares = np.where(np.arange(len(a)) % 50 == 0, 50 * error, 0.0)[:, None]
        # (p - a)(p - b) are these squares.
        return 0.5 * (a + b) + np.sqrt(squares + 0.25 * (a - b) ** 2)

    def train(loop: TrainingLoop, seconds: float) -> bool:
        assert loop.trainers[0].model.calibration is None
        return True

    monkeypatch.setattr(Trainer, "predict", predict)
    monkeypatch.setattr(TrainingLoop, "train", train)
    monkeypatch.setattr(module, "pilot_seconds", lambda *_: Estimate(0.01, 0.0, 5))
    return pilots


def test_the_law_of_the_pilots_predicts_the_fit(law: list[tuple[int, int]], shards: Path) -> None:
    found = forecast_fit(config(steps=STEPS, error=0.06), shards).error
    *pilots, (last, few) = law
    # About a tenth of the steps; the last pilot repeats its queries as often as the fit does.
    assert sum(steps for steps, _ in law) == pytest.approx(0.1 * STEPS, rel=0.1)
    assert [queries for _, queries in pilots] == [pilots[0][1]] * 6
    assert few / pilots[0][1] == pytest.approx(last / STEPS, rel=0.1)
    assert found.error is not None
    assert found.asked is not None
    assert found.seconds == 0.01 * STEPS
    true = 0.03 + 3.0 * STEPS**-0.7
    assert found.error.low < true < found.error.high
    assert found.error.value == pytest.approx(true, rel=0.2)
    assert found.excess.value == pytest.approx(0.1)
    # Of forty test queries, whose error limits all that is known.
    assert found.excess.error == pytest.approx(0.1 / math.sqrt(40), rel=0.05)
    assert found.error.value / found.error.low > math.exp(1.9 / math.sqrt(40))
    assert found.error.high > true + 0.1
    assert found.asked[1].low < 0.01 * 100 ** (1 / 0.7) < found.asked[1].high
    # What overfitting may add is more than what is asked for.
    assert found.asked[1].high == math.inf
    # Below the level at which the law ends.
    below = forecast_fit(config(steps=STEPS, error=0.01), shards).error.describe()
    assert "not reachable with these queries" in below


def test_too_few_steps_give_no_forecast(law: list[tuple[int, int]], shards: Path) -> None:
    found = forecast_fit(config(steps=30), shards).error
    assert found.error is None
    assert "30 steps are too few" in found.describe()


def test_training_stops_once_the_error_is_reached(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fits, "_REPORT_SECONDS", 0.02)
    asked = config(steps=3000, error=0.8, energy_calibration=False)
    found = fit(asked, shards, tmp_path / "early")
    *before, last = found.history
    assert last["unexplained"] + last["unexplained_error"] <= 0.8
    assert all(r["unexplained"] + r["unexplained_error"] > 0.8 for r in before)
    assert last["step"] < 3000
    # The error bar counts.
    for value, enough in ((0.77, True), (0.79, False), (None, False)):
        assert reached(asked, [{"unexplained": value, "unexplained_error": 0.02}]) is enough
    # What is exported is what was validated.
    assert found.errors["test"]["unexplained"]["value"] == pytest.approx(last["unexplained"], rel=0.1)
    assert found.as_dict()["reached"] is True
    never = config(steps=5, error=1e-6)
    found = fit(never, shards, tmp_path / "never")
    assert found.history[-1]["step"] == 5
    assert found.as_dict()["reached"] is False
    # Without an error to reach, fits are what they were, and no other configuration.
    assert reached(config(), found.history) is None
    assert "error" not in config().fields()["training"]


@pytest.mark.parametrize("options", [{"time": "3s"}, {"steps": 12}])
def test_a_forecast_matches_the_fit_that_follows(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, object]
) -> None:
    monkeypatch.setattr(module, "_PILOT_SECONDS", 0.1)
    monkeypatch.setattr(module, "_PIECE_SECONDS", 0.05)
    config = FitConfig.model_validate({"training": {"batch": 500, "warmup": 3, **options}})
    before = sorted(tmp_path.rglob("*")), sorted(shards.rglob("*"))
    found = forecast_fit(config, shards)
    assert (sorted(tmp_path.rglob("*")), sorted(shards.rglob("*"))) == before
    assert found.steps == pytest.approx(found.seconds * found.queries_per_second / 500, abs=0.5)
    assert found.seconds == 3.0 if "time" in options else found.steps == 12
    if "steps" in options:
        fit(config, shards, tmp_path / "material")
        # Names and shapes stand before the numbers, conformance queries beside them.
        size = (tmp_path / "material" / "weights.safetensors").stat().st_size
        assert found.bytes < size < found.bytes + 20480


def test_validation_uses_a_large_split(shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its queries have more paths, but few of them say less than what was held out."""

    def looked_at(shards: Path) -> tuple[str, ShardQueries]:
        data = open_data(shards, "neumip")
        return validation_set(data, load_training(data, HeldOutSection(), 0))

    name, queries = looked_at(shards)
    assert (name, len(queries)) == ("test", 2000)
    name, queries = looked_at(write_data(tmp_path / "few", parallax, train=6000, test=10))
    assert name == "held_out_queries"
    assert 10 < len(queries) < 200
    # Some thousand will do, however many were held out.
    monkeypatch.setattr(validation, "_FEWEST", 30)
    assert looked_at(write_data(tmp_path / "enough", parallax, train=6000, test=30))[0] == "test"


def test_the_last_validation_is_the_error_of_the_fit(shards: Path, tmp_path: Path) -> None:
    """All test queries are looked at here, so the last look is the fit's error itself."""
    config = FitConfig.model_validate({"training": {"batch": 500, "steps": 12, "energy_calibration": False}})
    found = fit(config, shards, tmp_path / "material")
    assert found.material.description["training"]["validation_set"] == "test"
    reached = found.errors["test"]["unexplained"]["value"]
    assert found.history[-1]["unexplained"] == pytest.approx(reached, rel=1e-5)
    assert found.errors["held_out_queries"]["unexplained"]["value"] != pytest.approx(reached, rel=1e-3)

"""Validations; an error that ends training."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.fit_data import parallax, write_data

import mbtf_fit.training.fit as fits
import mbtf_fit.training.validation as validation
from mbtf_fit import fit
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import load_training
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.sections import HeldOutSection
from mbtf_fit.training.endings import reached
from mbtf_fit.training.suitable_data import open_data
from mbtf_fit.training.validation import validation_set


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data") / "shards", parallax, train=20000, noise=0.01)


def config(**training: object) -> FitConfig:
    return FitConfig.model_validate({"model": "neumip", "training": {"batch": 200, "warmup": 3, **training}})


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

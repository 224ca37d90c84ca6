"""Forecasts of fits, which write nothing, and the set of the validations."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.fit_data import parallax, write_data

import mbtf_fit.training.forecast as module
import mbtf_fit.training.validation as validation
from mbtf_fit import fit
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import load_training, open_data
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.sections import HeldOutSection
from mbtf_fit.training.forecast import forecast_fit
from mbtf_fit.training.validation import validation_set


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data") / "shards", parallax, train=6000, noise=0.01)


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
        data = open_data(shards, "shuffled", "neumip")
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

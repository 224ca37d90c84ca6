"""Advice on a fit by data of other test queries."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from support.datasets import edit
from support.fit_data import constant, write_data

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.schema import MANIFEST_NAME
from mbtf_fit.cli.advice import advise
from mbtf_fit.config import FitConfig
from mbtf_fit.material.material import Material
from mbtf_fit.training.fit_folder import configuration_digest, training_digest

CONFIG: dict[str, Any] = {
    "material": "bricks",
    "light": {"width": 1.0},
    "queries": {"train": "100/texel", "test": "8192", "test_highlights": 0.0, "min_cos": 0.1},
}


def data(folder: Path, train: int, **changes: Any) -> Path:
    """Data of so many training queries, by this configuration with other values."""
    shards = write_data(folder, constant(0.1), train=train, test=100, seed=train)
    queries = {**CONFIG["queries"], **changes.pop("queries", {})}
    edit(
        shards / MANIFEST_NAME,
        lambda manifest: manifest.update(config=CONFIG | changes | {"queries": queries}),
    )
    return shards


def errors(test: float) -> dict[str, Any]:
    values = {"test": test, "training": 0.02}
    return {
        name: {"n": 8192, "unexplained": estimate, "mse": estimate}
        for name, estimate in ((k, {"value": v, "error": 0.001}) for k, v in values.items())
    }


@pytest.mark.parametrize(
    ("changes", "known"),
    [
        ({"queries": {"train": "1", "test": "32768", "test_highlights": 0.75}}, True),
        ({"queries": {"train": "1", "min_cos": 0.2}}, False),
        ({"light": {"width": 5.0}}, False),
    ],
)
def test_other_test_queries_of_the_same_configuration_give_the_next_step(
    changes: dict[str, Any], known: bool, tmp_path: Path
) -> None:
    """The fit seemed to have no error; that of other test queries exceeds that of the training queries."""
    fitted, other = data(tmp_path / "shards", 60), data(tmp_path / "shards-2", 1, **changes)
    trained = Dataset.open(fitted)
    training = {
        "shards_sha256": training_digest(trained),
        "data_sha256": configuration_digest(trained),
        "data_queries": "100/texel",
        "seconds": 30.0,
        "noise_variance": 1.0,
        "errors": errors(0.02),
    }
    material = SimpleNamespace(config=FitConfig(), description={"training": training})
    history = [
        {"fraction": f, "step": round(2000 * f), "unexplained": 0.02, "unexplained_error": 1e-4}
        for f in (0.5, 1.0)
    ]
    measured = {"test": errors(0.08)["test"]}
    command, lines = advise(cast(Material, material), Path("mat"), other, history, measured)
    if not known:
        assert command is None
        assert "other training data" in lines[0]
        return
    assert command is not None
    assert "--queries 200/texel" in command
    assert f"--config {other}" in command
    assert "--test-queries" not in command
    assert lines[0].endswith(command)

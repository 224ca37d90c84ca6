"""Advice on a fit by data of other test queries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support.datasets import edit
from support.fit_data import parallax, write_data

from mbtf_core.data.schema import MANIFEST_NAME
from mbtf_fit import FitConfig, fit
from mbtf_fit.cli.advice import advise

CONFIG: dict[str, Any] = {
    "material": "bricks",
    "light": {"width": 1.0},
    "queries": {"train": "100/texel", "test": "8192", "min_cos": 0.1},
}


def data(folder: Path, train: int, **changes: Any) -> Path:
    """Data of so many training queries, by this configuration with other values."""
    shards = write_data(folder, parallax, train=train, test=100, seed=train)
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
    other = data(tmp_path / "shards-2", 50, **changes)
    options = FitConfig.model_validate({"training": {"steps": 5, "batch": 100}})
    material = fit(options, data(tmp_path / "shards", 500), tmp_path / "mat").material
    # As of a fit that is trained well.
    material.description["training"] |= {"errors": errors(0.02), "noise_variance": 1.0}
    history = [
        {"fraction": f, "step": round(2000 * f), "unexplained": 0.02, "unexplained_error": 1e-4}
        for f in (0.5, 1.0)
    ]
    measured = {"test": errors(0.08)["test"]}
    command, lines = advise(material, Path("mat"), other, history, measured)
    if not known:
        assert command is None
        assert "other training data" in lines[0]
        return
    assert command is not None
    assert "--queries 200/texel" in command
    assert f"--config {other}" in command
    assert "--test-queries" not in command
    assert lines[0].endswith(command)

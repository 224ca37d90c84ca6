"""Fits of both layouts share one test split; times of their parts are scaled to all pixels."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.fit_data import parallax, write_data

from mbtf_core.app.console import Console
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import Lattice
from mbtf_fit.config import build_model
from mbtf_pipeline.compare import timing
from mbtf_pipeline.compare.metrics import dataset_errors
from mbtf_pipeline.compare.timing import LIGHTS, measure_timing
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run import _RecipeRun, data_sets


def recipe(layout: str, *models: str) -> Recipe:
    generate = {"material": "m", "queries": {"layout": layout, "train": "9/texel", "test": "4096"}}
    return Recipe.model_validate({"name": "r", "generate": generate, "fit": dict.fromkeys(models)})


@pytest.mark.parametrize("layout", ["shuffled", "image"])
def test_a_model_of_the_other_layout_gets_its_own_data_set(layout: str) -> None:
    other = {"shuffled": "image", "image": "shuffled"}[layout]
    made = recipe(layout, "neumip", "hierarchical")
    first, second = data_sets(made)
    assert first.config == made.generate
    assert (second.stage, second.sub) == (f"generate {other}", f"shards-{other}")
    assert second.config.queries.layout == other
    assert second.config.queries.train == made.generate.queries.train
    stages = _RecipeRun(made, Path(), Console(quiet=True)).stages({})
    assert [stage.name for stage in stages][:3] == ["generate", f"generate {other}", "fit neumip"]


class Shifted:
    """A material with a constant error."""

    def __init__(self, model: str, shift: float) -> None:
        self.shift = shift
        self.model = build_model(model, Lattice(3))
        self.config = SimpleNamespace(model=model)
        sizes = {"network_weights": sum(p.numel() for p in self.model.parameter_groups()[1]), "texels": 5}
        errors = {"test": {"mse": "of other data"}, "held_out_queries": {"mse": "own"}}
        self.description = {"weights": sizes, "training": {"errors": errors, "seconds": 3.0, "steps": 9}}

    def predict(self, q: Any) -> np.ndarray:
        return (parallax(q.u, q.sigma, q.omega_i, q.omega_o) + self.shift).astype(np.float32)


def test_all_fits_are_evaluated_on_the_same_test_queries(tmp_path: Path) -> None:
    data = Dataset.open(write_data(tmp_path / "shards", parallax, train=64, noise=0.02))
    fits: Any = {"a": Shifted("neumip", 0.1), "b": Shifted("hierarchical", 0.05)}
    found = dataset_errors(fits, data)
    for name, square in (("a", 0.01), ("b", 0.0025)):
        mse = found[name]["splits"]["test"]["mse"]
        assert abs(mse["value"] - square) < 4 * mse["error"]
        assert found[name]["splits"]["held_out_queries"] == {"mse": "own"}
    less = found["b"]["mse_minus_first"]
    assert abs(less["value"] - (0.0025 - 0.01)) < 4 * less["error"]
    # Shared noise cancels in the paired difference.
    assert less["error"] < found["a"]["splits"]["test"]["mse"]["error"]
    assert set(less["levels"]) == {"0", "1", "2", "3"}
    assert all(e["value"] + 4 * e["error"] < 0 for e in less["levels"].values())
    assert "mse_minus_first" not in found["a"]


@pytest.mark.parametrize("model", ["neumip-baseline", "neumip", "hierarchical"])
def test_times_scale_to_all_pixels(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """If every stage takes a second, only the scale remains."""

    def one_second(work: Any) -> tuple[Any, float]:
        return work(), 1.0

    monkeypatch.setattr(timing, "timed", one_second)
    network = build_model(model, Lattice(2))
    network.initialize(torch.Generator().manual_seed(0), 1.0)
    material: Any = SimpleNamespace(model=network, evaluate=lambda *arrays: arrays)
    pixels = 8 * 81 * 20
    found = measure_timing(material, pixels, "cpu")
    count = 20 if model == "hierarchical" else 81 * 20
    assert found["queries"] == count
    assert found["stage1_ms"] == pytest.approx(1e3 * pixels / count)
    for n in LIGHTS:
        expected = found["stage1_ms"] + n * found["stage2_ms"]
        assert found["lights_ms"][str(n)] == pytest.approx(expected)

"""Forecasts of runs."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.paths import ROOT

from mbtf_core.app.console import Console, run
from mbtf_core.data.shard_files import row_bytes
from mbtf_core.errors import InputError
from mbtf_core.files import folders
from mbtf_pipeline import run as runs
from mbtf_pipeline.cli.app import app
from mbtf_pipeline.forecast import RunForecaster, forecast_left
from mbtf_pipeline.recipe import load_recipe, preset_recipe
from mbtf_pipeline.stages import run_stages, write_run_record

FILE = ROOT / "pipelines" / "quickstart.yaml"
# One fit, at the resolution of each preset.
ONE = """\
name: one
generate: {material: maps/height.npy, geometry: {height_scale: 0.1}}
fit: {model: neumip}
"""
START, PATH = 4.5, 4e-7
PATHS = 400 * 128**2 * 4 + 32768 * 128
ROWS = 400 * 128**2 + 32768


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Free space on a machine of known speed."""
    made = SimpleNamespace(free=1e15)
    monkeypatch.setattr(RunForecaster, "speed", (START, PATH))
    monkeypatch.setattr(folders.shutil, "disk_usage", lambda path: made)
    return made


@pytest.fixture
def one(tmp_path: Path) -> Path:
    (tmp_path / "maps").mkdir()
    np.save(tmp_path / "maps" / "height.npy", np.random.default_rng(0).random((512, 512)))
    (tmp_path / "one.yaml").write_text(ONE)
    return tmp_path / "one.yaml"


def test_all_stages_count(disk: SimpleNamespace) -> None:
    recipe = load_recipe(FILE)
    forecaster = RunForecaster(recipe)
    found = forecaster.of(recipe)
    assert found.generating == pytest.approx(PATHS * PATH)
    assert found.training == 140.0
    # Eight pictures of 256 x 256 pixels and 96 paths.
    assert found.comparing == pytest.approx(5.0 + 8 * 256**2 * 96 * PATH, abs=2.0)
    data = ROWS * row_bytes(holes=False)
    assert data < found.bytes < data + 2e8
    parts = (found.start, found.generating, found.training, found.evaluating, found.comparing)
    assert found.seconds == sum(parts)
    by_steps = forecaster.of(load_recipe(FILE, ["fit.neumip.training.steps=100"]))
    assert by_steps.training == 80.0
    recipe = load_recipe(FILE)
    # What is finished costs nothing.
    left = forecaster.of(recipe, ["fit neumip", "compare", "report"])
    assert (left.generating, left.training) == (0.0, 60.0)
    assert left.bytes < 2e8


def test_a_run_states_its_cost_and_is_refused_if_the_disk_is_full(
    disk: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(runs, "run_recipe", stop)
    out = tmp_path / "out"
    assert run(app, ["run", str(FILE), "-o", str(out)]) == 130
    said = capsys.readouterr().err
    assert "expected: about 3:" in said
    disk.free = 1e6
    assert run(app, ["run", str(FILE), "-o", str(out)]) == 3
    problem, hint = capsys.readouterr().err.splitlines()
    assert re.match(re.escape(f"error: {out}: needs ") + r"5[3-6]\d MB; 1\.0 MB are free", problem)
    assert "--set" in hint
    assert not out.exists()
    with pytest.raises(InputError, match="holds no run"):
        forecast_left(load_recipe(FILE), ROOT / "pipelines")


def test_a_run_that_is_resumed_has_less_to_do(disk: SimpleNamespace, one: Path) -> None:
    """Its data are there."""
    recipe, folder = preset_recipe(one, "draft", ["fit.training.time=5min"]), one.parent / "run"
    folder.mkdir()
    write_run_record(folder, recipe, "command")
    first, *others = runs._RecipeRun(recipe, folder, Console(quiet=True)).stages(
        runs._material_inputs(recipe)
    )
    run_stages(folder, [replace(first, outputs=(), run=lambda decision: None)])
    left = RunForecaster(recipe).of(recipe, [stage.name for stage in others])
    assert (left.start, left.generating) == (2.5, 0.0)
    assert forecast_left(recipe, folder) == left.describe()

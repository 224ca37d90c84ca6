"""A recipe states its time and size before it runs, and is refused where it does not fit on the disk."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.paths import ROOT

from mbtf_core.app.console import run
from mbtf_core.data.shard_files import row_bytes
from mbtf_core.errors import InputError
from mbtf_core.files import folders
from mbtf_pipeline import run as runs
from mbtf_pipeline.cli.app import app
from mbtf_pipeline.forecast import RunForecaster, forecast_left
from mbtf_pipeline.recipe import load_recipe

FILE = ROOT / "pipelines" / "quickstart.yaml"
PATHS = 400 * 128**2 * 4 + 32768 * 128
ROWS = 400 * 128**2 + 32768


@pytest.fixture(autouse=True)
def speed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RunForecaster, "speed", property(lambda self: (5.0, 1e-6)))


def test_all_stages_count() -> None:
    recipe = load_recipe(FILE)
    forecaster = RunForecaster(recipe)
    found = forecaster.of(recipe)
    assert found.generating == pytest.approx(PATHS * 1e-6)
    assert found.training == 120.0
    # Eight pictures of 256 x 256 pixels and 96 paths.
    assert found.comparing == pytest.approx(5.0 + 8 * 256**2 * 96 * 1e-6, abs=2.0)
    data = ROWS * row_bytes(holes=False)
    assert data < found.bytes < data + 2e8
    parts = (found.start, found.generating, found.training, found.evaluating, found.comparing)
    assert found.seconds == sum(parts)
    assert found.describe().startswith("expected: about 3:")
    # What is finished costs nothing.
    left = forecaster.of(recipe, ["fit neumip", "compare", "report"])
    assert (left.generating, left.training) == (0.0, 60.0)
    assert left.bytes < 2e8


def test_fits_by_steps_are_named() -> None:
    recipe = load_recipe(FILE, ["fit.neumip.training.steps=100"])
    found = RunForecaster(recipe).of(recipe)
    assert found.training == 60.0
    assert found.describe().endswith(", and the steps of neumip")


def test_short_runs_need_no_pilot(tmp_path: Path) -> None:
    assert forecast_left(load_recipe(ROOT / "pipelines" / "ci.yaml"), tmp_path / "out") is None
    assert forecast_left(load_recipe(FILE), tmp_path / "out") is not None


def test_a_run_states_its_cost_and_is_refused_if_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(runs, "run_recipe", stop)
    out = tmp_path / "out"
    assert run(app, ["run", str(FILE), "-o", str(out)]) == 130
    assert "expected: about 3:" in capsys.readouterr().err
    monkeypatch.setattr(folders.shutil, "disk_usage", lambda path: SimpleNamespace(free=1e6))
    assert run(app, ["run", str(FILE), "-o", str(out)]) == 3
    problem, hint = capsys.readouterr().err.splitlines()
    assert problem.startswith(f"error: {out}: needs 519 MB; 1.0 MB are free")
    assert "--set" in hint
    assert not out.exists()
    with pytest.raises(InputError, match="holds no run"):
        forecast_left(load_recipe(FILE), ROOT / "pipelines")

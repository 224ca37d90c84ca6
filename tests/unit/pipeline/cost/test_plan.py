"""The dry run of a cost study plans by what the machine has left."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from support.paths import ROOT

from mbtf_pipeline.cost import plan
from mbtf_pipeline.cost.schedule import OVERHEAD
from mbtf_pipeline.recipe import load_recipe


def test_other_work_makes_runs_fewer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    recipe = load_recipe(ROOT / "pipelines" / "quickstart.yaml", [])
    pilot = SimpleNamespace(query_seconds=4e-6, start=2.0)
    monkeypatch.setattr(plan, "forecast", lambda *_, **__: pilot)
    free = plan.plan_study(recipe, tmp_path / "study", seconds=200.0)
    monkeypatch.setattr(plan, "processor_share", lambda: 0.25)
    busy = plan.plan_study(recipe, tmp_path / "study", seconds=200.0)
    assert (free.overhead, busy.overhead) == (OVERHEAD, 4 * OVERHEAD)
    assert 0 < len(busy.runs) < len(free.runs)
    assert busy.least > free.least
    assert "25% of the processors" in busy.describe(200.0)
    assert not (tmp_path / "study").exists()

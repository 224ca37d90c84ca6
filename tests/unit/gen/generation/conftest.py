"""Small runs whose values come from a formula."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.formula_runs import SMALL, Formula, cheap_plan

from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation import run as generation


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Formula:
    fake = Formula()
    monkeypatch.setattr(generation, "plan_run", cheap_plan)
    monkeypatch.setattr(generation, "build_estimator", lambda job, plan: fake)
    return fake


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


@pytest.fixture
def config(tmp_path: Path) -> GeneratorConfig:
    np.save(tmp_path / "height.npy", np.random.default_rng(0).random((4, 8)))
    return GeneratorConfig.model_validate({"material": str(tmp_path / "height.npy"), **SMALL})

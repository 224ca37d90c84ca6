"""A total time is kept, and the same command splits it the same way."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.paths import ROOT

from mbtf_core.errors import InputError, UsageError
from mbtf_core.stats import Estimate
from mbtf_core.units import parse_duration
from mbtf_fit.config import FitConfig
from mbtf_pipeline.cost_study import time_split as module
from mbtf_pipeline.cost_study.runs import RunRunner
from mbtf_pipeline.cost_study.time_split import DEFAULT_SHARE, SHARES, split_time, with_split
from mbtf_pipeline.recipe import Recipe, load_recipe

# Seconds of a training query, of starting with the test split, of a fit besides training, and by query.
QUERY, START, FIT, FIT_QUERY = 2e-6, 4.5, 4.0, 5e-7


def recipe(*assignments: str) -> Recipe:
    return load_recipe(ROOT / "pipelines" / "quickstart.yaml", list(assignments))


class Machine:
    """Pilots take no time here; their error is lowest where `best` of their time generates."""

    def __init__(self) -> None:
        self.best = 0.6
        self.pilots: list[Any] = []
        self.failing = self.undefined = False
        self.free, self.memory, self.query = 1e15, 1e15, QUERY
        self.now = self.pilot_takes = 0.0

    def measure(self, run: Any) -> Any:
        self.pilots.append(run)
        self.now += self.pilot_takes
        if self.failing:
            raise InputError("training diverged at step 7", hint="lower the learning rate")
        generating = run.data.queries * self.query
        training = parse_duration(run.fit["training"]["time"])
        share = generating / (generating + training)
        error = math.nan if self.undefined else 0.1 + (share - self.best) ** 2
        other = FIT + FIT_QUERY * run.data.queries
        details = {"generation_seconds": generating, "training_seconds": training}
        details["total_seconds"] = generating + training + other
        return SimpleNamespace(error=Estimate(error, 0.01, 10), details=details)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Machine:
    made = Machine()
    monkeypatch.setattr(RunRunner, "measure", lambda self, run: made.measure(run))
    monkeypatch.setattr(module, "forecast_seconds", lambda config: (made.query, START))
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: made.now))
    monkeypatch.setattr(module.shutil, "disk_usage", lambda path: SimpleNamespace(free=made.free))
    monkeypatch.setattr(module, "_physical_memory", lambda: made.memory)
    return made


def split(
    folder: Path, seconds: float = 1000.0, of: Recipe | None = None, notes: list[str] | None = None
) -> Any:
    return split_time(
        of or recipe(), seconds, folder / "run", "command", ([] if notes is None else notes).append
    )


@pytest.mark.parametrize("best", SHARES)
def test_the_best_pilot_decides(fake: Machine, tmp_path: Path, best: float) -> None:
    fake.best, fake.pilot_takes = best, 80.0
    notes: list[str] = []
    found = split(tmp_path, notes=notes)
    times = [parse_duration(run.fit["training"]["time"]) for run in fake.pilots]
    assert times == pytest.approx([40 * (1 - s) for s in SHARES], rel=0.01)
    assert [run.data.queries * QUERY for run in fake.pilots] == pytest.approx(
        [40 * s for s in SHARES], rel=0.1
    )
    assert len(notes) == len(found.pilots) == 3
    assert found.share == best
    making = found.generating - START
    assert making / (making + found.training) == pytest.approx(best, rel=0.1)
    assert making == pytest.approx(found.queries * QUERY, abs=0.1)


@pytest.mark.parametrize("seconds", [60.0, 100.0, 250.0, 1000.0, 36000.0])
def test_all_parts_fit_into_the_time(fake: Machine, tmp_path: Path, seconds: float) -> None:
    fake.pilot_takes = 0.05 * seconds
    found = split(tmp_path, seconds)
    # Both fits load what is generated.
    pilots = 0.15 * seconds if fake.pilots else 0.0
    assert found.pilot_seconds == pytest.approx(pilots)
    other = 2 * (FIT + FIT_QUERY * found.queries) if fake.pilots else found.other
    assert found.other == pytest.approx(other, abs=0.1)
    spent = found.pilot_seconds + found.generating + found.training + found.other
    assert spent == pytest.approx(seconds, abs=0.3)
    assert bool(fake.pilots) == (seconds >= 250)
    assert fake.pilots or found.share == DEFAULT_SHARE


def test_pilots_that_fail_or_have_nothing_to_learn_leave_the_default(fake: Machine, tmp_path: Path) -> None:
    fake.undefined = True
    found = split(tmp_path / "flat")
    assert (found.share, found.pilots) == (DEFAULT_SHARE, [])
    fake.failing = True
    notes: list[str] = []
    assert split(tmp_path / "failed", notes=notes).share == DEFAULT_SHARE
    assert notes == ["pilot failed: training diverged at step 7; 35% of the time generates"]


def test_pilots_train_where_the_fit_does(fake: Machine, tmp_path: Path) -> None:
    split(tmp_path, of=recipe("fit.neumip.device=cpu", "fit.neumip.data.memory=3 GB"))
    for run in fake.pilots:
        config = FitConfig.model_validate(run.fit)
        assert (config.device, config.data.memory) == ("cpu", 3e9)


@pytest.mark.parametrize("scarce", ["disk", "memory"])
def test_disk_and_memory_limit_the_queries(fake: Machine, tmp_path: Path, scarce: str) -> None:
    """Queries of a closed form would fill the disk in any time, which goes to training instead."""
    fake.query = 1e-12
    if scarce == "disk":
        fake.free = 8e7
    else:
        fake.memory = 4e7
    found = split(tmp_path)
    # A quarter of the disk or half of the memory, 68 bytes a query.
    most = 20e6 / 68
    assert 0.9 * most < found.queries <= most
    assert [run.data.queries for run in fake.pilots] == [found.queries] * 3
    assert found.training > 980.0


def test_fits_share_the_time_of_training(fake: Machine, tmp_path: Path) -> None:
    plain = recipe()
    found = split(tmp_path, 100.0)
    changed = with_split(plain, found)
    assert changed.generate.queries.train == str(found.queries)
    assert len(changed.fit) == 2
    assert sum(fit.training.time for fit in changed.fit.values()) == pytest.approx(found.training, abs=0.2)
    assert all(fit.training.steps is None for fit in changed.fit.values())
    assert changed.compare == plain.compare
    assert changed.generate.light == plain.generate.light


def test_the_same_command_resumes_with_the_same_split(fake: Machine, tmp_path: Path) -> None:
    first = split(tmp_path)
    fake.query *= 1.5
    assert split(tmp_path) == first
    assert len(fake.pilots) == 3
    # Another time, or a damaged record, is split anew.
    assert split(tmp_path, 900.0) != first
    again = split(tmp_path)
    assert again.queries < first.queries
    (tmp_path / "run" / module.SPLIT_NAME).write_text('{"format": "mbtf-time-split"}')
    assert split(tmp_path) == again


def test_what_cannot_be_split_is_refused(fake: Machine, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="too short"):
        split(tmp_path, 5.0)
    with pytest.raises(UsageError, match="layout"):
        split(tmp_path, 100.0, recipe("fit.h.model=hierarchical"))
    assert not (tmp_path / "run").exists()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "file").write_text("")
    with pytest.raises(InputError, match="holds no run"):
        split(tmp_path, 100.0)


def test_a_given_share_needs_no_pilots(fake: Machine, tmp_path: Path) -> None:
    found = split_time(recipe(), 1000.0, tmp_path / "run", "command", print, 0.25)
    assert not fake.pilots
    making = found.generating - START
    assert making / (making + found.training) == pytest.approx(0.25, rel=0.05)

"""Cost studies: within their time, resumable, never mixed with others."""

from __future__ import annotations

import errno
import math
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.fake_runs import FakeRuns, MemoryStore, conditions, run
from support.paths import ROOT

from mbtf_core.errors import InputError, PartialError
from mbtf_core.stats import Estimate
from mbtf_pipeline.cost import study as module
from mbtf_pipeline.cost.generator import GeneratorBenchmark, GeneratorConfiguration
from mbtf_pipeline.cost.measurement import (
    Conditions,
    Measurement,
    MeasurementFolder,
)
from mbtf_pipeline.cost.runs import Run
from mbtf_pipeline.cost.study import Measurements
from mbtf_pipeline.recipe import load_recipe

RECIPE = ROOT / "pipelines" / "quickstart.yaml"
ONE = Estimate(1.0, 0.1, 4)


def point(seconds: float, error: float, study: str = "run", **details: float) -> Measurement:
    estimates = Estimate(seconds, 0.0, 1), Estimate(error, 0.01, 9)
    return Measurement(study, "s", f"{seconds:g}", "command", *estimates, details=details)


def test_measurements_come_back_and_damaged_ones_are_repeated(tmp_path: Path) -> None:
    store = MeasurementFolder(tmp_path, conditions())
    mesh = GeneratorConfiguration("mesh", "", "64 cells", {"geometry.mesh": 64})
    kept = Measurement("mesh", "", "64 cells", mesh.command(conditions()), ONE, ONE, ONE, None, {"b": 12.0})
    store.put(mesh, kept)
    store.put(run(), point(5.0, math.nan))
    assert store.get(mesh) == kept
    found = store.get(run())
    assert found is not None
    assert math.isnan(found.error.value)
    assert store.get(replace(mesh, changes={})) is store.get(replace(mesh, study="paths")) is None
    assert MeasurementFolder(tmp_path, replace(conditions(), basis="other")).get(mesh) is None
    (path,) = store.folder.glob("mesh-*")
    path.write_text(path.read_text()[:-20])
    assert store.get(mesh) is None


def test_a_run_that_fails_does_not_stop_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    def measure(self: Run, conditions: Conditions) -> Measurement:
        if self.name == "diverges":
            raise InputError("training diverged at step 7")
        spent = {"run_seconds": 24.0, "training_seconds": 5.0, "training_steps": 5000.0}
        return point(5.0, 0.1, **spent)

    monkeypatch.setattr(Run, "measure", measure)
    runs = [run(3000, "long", 9.0), run(2000, "one"), run(900, "diverges")]
    planned = [replace(run, seed=seed) for seed in range(2) for run in runs]
    found = Measurements(conditions(), MemoryStore())  # type: ignore[arg-type]
    found.measure_runs(planned, lambda run: True)
    assert found.failed == {runs[2].label: "training diverged at step 7"}
    assert [len(found.group(run)) for run in runs] == [2, 2, 0]
    # Training, and what the others have taken besides, at most.
    assert found.expected_seconds(runs[1]) == 24.0


RUNS = [run(3000, "long", 7200.0), run(2000, "short", 60.0), run(1000, "m", 40.0)]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeRuns:
    """Studies of one configuration of the generator and three runs, of which the first takes too long."""
    found = FakeRuns(seeds=0.5)
    clock: Any = SimpleNamespace(now=0.0, perf_counter=lambda: clock.now, strftime=lambda form: "2001-02-03")

    def measure(run: Run, conditions: Conditions) -> Measurement:
        clock.now += run.planned_seconds(0.0)
        return found.measure(run)

    result = Measurement("paths", "uniform", "4", "", ONE, ONE, None, ONE, {"spp": 4.0})
    monkeypatch.setattr(GeneratorConfiguration, "measure", lambda *_: result)
    configuration = GeneratorConfiguration("paths", "uniform", "4", {"queries.spp": 4}, None)
    monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(Run, "measure", measure)
    monkeypatch.setattr(module, "generator_configurations", lambda benchmark: [configuration])
    monkeypatch.setattr(GeneratorBenchmark, "check_variation", lambda benchmark: None)
    planned = [replace(run, seed=seed) for run in RUNS for seed in range(2)]
    monkeypatch.setattr(module, "planned_runs", lambda *_: planned)
    monkeypatch.setattr(module, "path_seconds", lambda *_: 1e-9)
    return found


def test_a_study_keeps_its_time_and_resumes(fake: FakeRuns, tmp_path: Path) -> None:
    recipe, folder = load_recipe(RECIPE, []), tmp_path / "study"

    def measured(**options: Any) -> tuple[module.Study, list[Run]]:
        fake.measured.clear()
        return module.run_study(recipe, folder, **options), [*fake.measured]

    # Two runs of 60 s and one of 40 s.
    shares = list[float]()
    first, runs = measured(seconds=190.0, progress=lambda share, note: shares.append(share))
    assert first.description["taken"] == sum(r.planned_seconds(0.0) for r in runs)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert [m.details.get("seeds") for m in first.measurements] == [None, 1, 2]
    assert sum(r.planned_seconds(0.0) for r in runs) <= 190.0
    assert first.skipped == ["run, neumip, long"]
    # Only what is missing is measured: the second seed of the last run.
    second, runs = measured(seconds=190.0)
    assert [(r.name, r.seed) for r in runs] == [("m", 1)]
    assert second.measurements[2].error.value == first.measurements[2].error.value


def test_a_full_disk_keeps_what_is_measured(
    fake: FakeRuns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, folder = load_recipe(RECIPE, []), tmp_path / "study"
    put = MeasurementFolder.put

    def full(store: MeasurementFolder, of: Any, measurement: Measurement) -> None:
        if (of.name, getattr(of, "seed", 0)) == ("short", 1):
            with monkeypatch.context() as patch:
                patch.setattr(os, "fsync", no_space)
                put(store, of, measurement)
        put(store, of, measurement)

    def no_space(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(MeasurementFolder, "put", full)
    with pytest.raises(PartialError, match="No space left on device"):
        module.run_study(recipe, folder, seconds=190.0)
    assert not (folder / ".work").exists()
    kept = [(run.name, run.seed) for run in fake.measured]
    monkeypatch.setattr(MeasurementFolder, "put", put)
    fake.measured.clear()
    module.run_study(recipe, folder, seconds=190.0)
    again = [(run.name, run.seed) for run in fake.measured]
    # The run whose result did not fit is repeated, no other.
    assert kept[-1] == again[0] == ("short", 1)
    assert not set(kept[:-1]) & set(again)


def test_other_seeds_and_materials_are_not_mixed(fake: FakeRuns, tmp_path: Path) -> None:
    for option, count in (("seed=0", 4), ("seed=0", 0), ("seed=7", 4), ("material=assets/twisted_wool", 4)):
        fake.measured.clear()
        module.run_study(load_recipe(RECIPE, [f"generate.{option}"]), tmp_path / "study", seconds=600.0)
        assert len(fake.measured) == count

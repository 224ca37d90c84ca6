"""Cost studies: within their time, resumable, never mixed with others; fronts and what follows from them."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.fake_runs import FakeRunner, run
from support.paths import ROOT

from mbtf_core.errors import InputError
from mbtf_core.files import folders
from mbtf_core.files.atomic import write_json
from mbtf_core.stats import Estimate
from mbtf_pipeline.cost import study as module
from mbtf_pipeline.cost.cost_page import to_csv
from mbtf_pipeline.cost.generator_runs import GeneratorTask
from mbtf_pipeline.cost.measurements import Measurement, MeasurementFolder
from mbtf_pipeline.cost.pareto import extrapolation, pareto_front
from mbtf_pipeline.cost.runs import Run
from mbtf_pipeline.recipe import load_recipe
from mbtf_pipeline.run_folder import machine

RECIPE = ROOT / "pipelines" / "quickstart.yaml"
ONE = Estimate(1.0, 0.1, 4)


def point(seconds: float, error: float, study: str = "whole", **details: float) -> Measurement:
    estimates = Estimate(seconds, 0.0, 1), Estimate(error, 0.01, 9)
    return Measurement(study, "s", f"{seconds:g}", "command", *estimates, details=details)


def test_the_front_holds_what_nothing_beats() -> None:
    found = [(10, 0.5), (20, 0.6), (20, 0.4), (40, 0.4), (80, 0.1), (5, math.nan), (90, 0.2)]
    front = pareto_front([point(*pair) for pair in found])
    assert [(m.seconds.value, m.error.value) for m in front] == [(10, 0.5), (20, 0.4), (80, 0.1)]


def test_the_extrapolation_follows_the_end_of_the_front() -> None:
    """A front that ends with the power of one half: half the error takes four times as long."""
    front = [point(t, 0.2 * (t / 20) ** -2) for t in (5.0, 10.0)]
    front += [point(t, 0.2 * (t / 20) ** -0.5) for t in (20.0, 40.0, 80.0)]
    found = extrapolation(front)
    assert found is not None
    assert found[0] == pytest.approx(3 * 80.0)
    assert found[1].value == pytest.approx(0.5)
    assert found[1].error > 0
    assert extrapolation(front[:2]) is None
    # Nothing is promised where the error bars allow no progress.
    assert extrapolation([point(t, e) for t, e in ((20.0, 0.2), (40.0, 0.199), (80.0, 0.198))]) is None


def test_measurements_come_back_and_damaged_ones_are_repeated(tmp_path: Path) -> None:
    store = MeasurementFolder(tmp_path, "abc")
    mesh = GeneratorTask("mesh", "", "64 cells", {"geometry.mesh": 64})
    kept = Measurement("mesh", "", "64 cells", "mbtf-gen", ONE, ONE, ONE, None, {"bytes": 12.0})
    store.put(mesh, kept)
    store.put(run(), Measurement("whole", "m", "5 s", "", ONE, Estimate(math.nan, math.inf, 100)))
    assert store.get(mesh, "mbtf-gen") == kept
    found = store.get(run())
    assert found is not None
    assert math.isnan(found.error.value)
    assert store.get(replace(mesh, changes={})) is store.get(replace(mesh, study="paths")) is None
    assert MeasurementFolder(tmp_path, "abd").get(mesh) is None
    (path,) = store.folder.glob("mesh-*")
    path.write_text(path.read_text()[:-20])
    assert store.get(mesh) is None


def test_the_csv_holds_every_number_with_its_error() -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv([point(10, 0.5, bytes=3e5), point(20, math.nan)]))))
    assert (rows[0]["seconds"], rows[0]["error"], rows[0]["error_se"]) == ("10", "0.5", "0.01")
    assert (rows[0]["bytes"], rows[0]["bias"], rows[1]["error"]) == ("300000", "", "")


def test_folders_of_something_else_are_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(InputError, match="holds no cost study"):
        module.claim(tmp_path, machine())
    folder = tmp_path / "study"
    module.claim(folder, machine())
    folder.mkdir()
    record = {"format": module.STUDY.format, "schema": module.STUDY.schema, "machine": machine()}
    changes: list[tuple[dict[str, Any], str | None]] = [
        ({}, None),
        ({"machine": {"system": "Plan 9"}}, r"another kind of machine .Plan 9; this is "),
        ({"schema": 1}, "schema version 1"),
    ]
    for change, message in changes:
        write_json(folder / module.STUDY.record, {**record, **change})
        if message is None:
            module.claim(folder, machine())
        else:
            with pytest.raises(InputError, match=message):
                module.claim(folder, machine())


RUNS = [run(3000, "long", 7200.0), run(2000, "short", 60.0), run(1000, "m", 40.0)]


@pytest.fixture
def runners(monkeypatch: pytest.MonkeyPatch) -> list[FakeRunner]:
    """Studies of one configuration of the generator and three runs, of which the first takes too long."""
    found: list[FakeRunner] = []
    clock = SimpleNamespace(now=0.0, perf_counter=lambda: clock.now, strftime=lambda form: "2001-02-03")

    class Runner(FakeRunner):
        def __init__(self, config: Any, *_: Any, path_seconds: Any) -> None:
            super().__init__(seeds=0.5)
            self.config = config
            found.append(self)
            self.path_seconds = path_seconds

        def measure(self, run: Run) -> Measurement:
            clock.now += self.expected_seconds(run)
            return super().measure(run)

    result = Measurement("paths", "uniform", "4", "", ONE, ONE, None, ONE)
    monkeypatch.setattr(GeneratorTask, "run", lambda *_: result)
    task = GeneratorTask("paths", "uniform", "4", {"queries.spp": 4}, None)
    monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(module, "RunRunner", Runner)
    monkeypatch.setattr(module, "generator_tasks", lambda benchmark: [task])
    monkeypatch.setattr(module, "path_seconds", lambda *_: 1e-9)
    monkeypatch.setattr(module, "_check_variation", lambda benchmark: None)
    monkeypatch.setattr(module, "planned_runs", lambda *_: RUNS)
    return found


def test_a_study_keeps_its_time_and_resumes(runners: list[FakeRunner], tmp_path: Path) -> None:
    recipe, folder = load_recipe(RECIPE, []), tmp_path / "study"
    # Two runs of 60 s and one of 40 s.
    first = module.run_study(recipe, folder, seconds=190.0)
    assert [m.details.get("seeds") for m in first.measurements] == [None, 2, 1]
    assert sum(r.fit["training"]["time"] for r in runners[0].measured) <= 190.0
    assert first.skipped == ["complete run: neumip, long"]
    assert first.deviation is not None
    # Only what is missing is measured: the second seed of the last run.
    second = module.run_study(recipe, folder, seconds=190.0)
    assert [(r.name, r.data.seed) for r in runners[1].measured] == [("m", 1)]
    # Refining takes its own time, for further seeds.
    module.run_study(recipe, folder, seconds=190.0, refine=3600.0)
    assert {r.data.seed for r in runners[2].measured} >= {2}
    assert all(r.name != "long" for r in runners[2].measured)
    assert sum(r.fit["training"]["time"] for r in runners[2].measured) <= 3790.0
    assert module.time_of(folder) == 190.0
    assert module.time_of(tmp_path / "none") == module.NEW_TIME
    assert second.measurements[1].error.value == first.measurements[1].error.value


def test_a_study_states_its_size_and_is_refused_if_the_disk_is_full(
    runners: list[FakeRunner], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, folder, said = load_recipe(RECIPE, []), tmp_path / "study", list[str]()
    monkeypatch.setattr(folders.shutil, "disk_usage", lambda path: SimpleNamespace(free=1e6))
    with pytest.raises(InputError, match=r"needs 72 MB; 1.0 MB are free\n.*--time"):
        module.run_study(recipe, folder, seconds=150.0, announce=said.append)
    assert not folder.exists()
    assert not said
    monkeypatch.undo()
    assert module.disk_bytes(RUNS) == (module.TEST[0] + 3000) * 68


def test_other_seeds_and_materials_are_not_mixed(runners: list[FakeRunner], tmp_path: Path) -> None:
    recipe = load_recipe(RECIPE, [])
    wool = load_recipe(RECIPE, ["generate.material=assets/twisted_wool"])
    for one, seed, measured in ((recipe, None, 4), (recipe, None, 0), (recipe, 7, 4), (wool, None, 4)):
        module.run_study(one, tmp_path / "study", seconds=600.0, seed=seed)
        assert len(runners[-1].measured) == measured
        assert runners[-1].config.seed == (seed or 0)


def test_a_refused_study_leaves_the_folder_as_it_was(
    runners: list[FakeRunner], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, folder = load_recipe(RECIPE, []), tmp_path / "study"
    module.run_study(recipe, folder, seconds=600.0)

    def content() -> dict[Path, bytes]:
        return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file() and "lock" not in p.name}

    before = content()

    def refuse(benchmark: Any) -> None:
        raise InputError("reflects nothing")

    monkeypatch.setattr(module, "_check_variation", refuse)
    with pytest.raises(InputError, match="reflects nothing"):
        module.run_study(recipe, folder, seconds=60.0, seed=5)
    assert content() == before

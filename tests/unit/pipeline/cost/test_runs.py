"""Runs of a cost study: which are planned, what they take and leave, and commands that reproduce them."""

from __future__ import annotations

import importlib
import shlex
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.fake_runs import conditions

import mbtf_fit
from mbtf_core.config.settings import resolve
from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.files.atomic import write_text
from mbtf_fit.config import FitConfig
from mbtf_fit.data.queries import ShardQueries
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.cost import runs as module
from mbtf_pipeline.cost.runs import GENERATOR, RUNS, Run, planned_runs

FIT = {"model": "neumip", "training.time": "5s"}


@pytest.mark.parametrize("seconds", [300.0, 36000.0])
def test_planned_runs_fit_into_the_time(seconds: float) -> None:
    found = planned_runs(seconds, 4, 7.5e-7)
    spent = sum(run.planned_seconds(7.5e-7) for run in found)
    assert 0.8 * RUNS * seconds < spent <= 1.05 * RUNS * seconds
    assert GENERATOR + RUNS < 0.9
    assert len({str(run.key) for run in found}) == len(found)
    # Total times double, so that a longer study keeps the runs of a shorter one.
    longer = planned_runs(2 * seconds, 4, 7.5e-7)
    doubling = [run for run in found if "35%" in run.series and run.seed == 0]
    assert found[: len(doubling)] == doubling
    assert all(run in longer for run in doubling)
    # The shortest run has the fewest steps, here of 0.1 s each, and not many more.
    assert 20.0 <= planned_runs(seconds, 4, 7.5e-7, 0.1)[0].planned_seconds(0.0) < 40.0


@pytest.fixture
def used(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Configurations of all data and fits. Generating takes seven seconds, fitting five, one more to load;
    evaluating 2¹⁸ queries half a second. The fit answers with a constant 0.1 where values are 0 and 1."""
    clock: Any = SimpleNamespace(now=0.0, perf_counter=lambda: clock.now)
    configs: list[Any] = []

    class Material:
        def predict(self, queries: Any) -> Any:
            return np.full((len(queries), 3), 0.1, np.float32)

        def evaluate(self, u: Any, *_: Any) -> None:
            assert len(u) == 1 << 18
            clock.now += 0.5

    def generate(job: Any, folder: Path) -> None:
        configs.append(job.config)
        clock.now += 7.0

    def fit(config: Any, shards: Path, out: Path) -> Any:
        configs.append(config)
        clock.now += 6.0
        out.mkdir(parents=True)
        (out / "weights.safetensors").write_bytes(bytes(100))
        return SimpleNamespace(material=Material(), seconds=5.0, total_seconds=6.0, history=[{"step": 700}])

    value = np.repeat(np.arange(1000) % 2.0, 3).reshape(1000, 3).astype(np.float32)
    zero = np.zeros((1000, 3), np.float32)
    test = ShardQueries(zero[:, :2], zero[:, 0], zero, zero, value, value)
    monkeypatch.setattr(module, "generate", generate)
    monkeypatch.setattr(module, "Job", SimpleNamespace(load=lambda config: SimpleNamespace(config=config)))
    monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr("mbtf_core.data.dataset.Dataset.open", lambda folder: folder)
    # Modules that are first imported now would keep the substitute.
    importlib.import_module("mbtf_fit.evaluation")
    monkeypatch.setattr("mbtf_fit.data.loader.load_split", lambda data, split: test)
    monkeypatch.setattr(mbtf_fit, "fit", fit)
    module.test_set.cache_clear()
    return configs


def test_a_run_measures_time_and_error(used: list[Any], tmp_path: Path) -> None:
    found = Run("run", "", "", 640, 4, FIT).measure(conditions(tmp_path))
    assert found.seconds.value == 13.0
    d = found.details
    assert (d["generation_seconds"], d["training_seconds"], d["total_seconds"]) == (7, 5, 13)
    assert d["training_steps"] == 700
    # Five timed evaluations.
    assert (d["queries"], d["spp"], d["bytes"], d["run_seconds"]) == (640, 4, 100, 13 + 5 * 0.5)
    assert d["evaluation_ms_1080p"] == pytest.approx(500 * 1920 * 1080 / 2**18)
    # Mean squares of 0.1 and 0.9 over the variance of a quarter.
    assert found.error.value == pytest.approx((0.01 + 0.81) / 2 / (0.25 * 1000 / 999), rel=1e-5)
    assert 0 < found.error.error < 0.1 * found.error.value


def test_every_seed_has_its_data_and_fit_and_all_one_test_set(used: list[Any], tmp_path: Path) -> None:
    for seed in (0, 2, 0):
        Run("run", "", "", 64, 4, FIT, seed).measure(conditions(tmp_path, seed=5))
    # Test set, data and fit, data and fit, …
    assert [config.seed for config in used] == [5, 5, 5, 7, 7, 5, 5]
    assert [c.queries.test for c in used if hasattr(c, "queries")].count(str(module.TEST[0])) == 1


@pytest.mark.parametrize(("study_seed", "offset"), [(0, 0), (0, 2), (5, 0), (5, 2)])
def test_commands_reproduce_their_run(used: list[Any], tmp_path: Path, study_seed: int, offset: int) -> None:
    """The programs resolve the command to the configurations that were measured."""
    study = conditions(tmp_path, seed=study_seed)
    write_text(tmp_path / "generate.yaml", dump_yaml(study.config.model_dump(mode="json")))
    planned = planned_runs(600.0, 6, 1.5e-7)
    for run in (planned[0], planned[-1]):
        command = Run("run", "", "", run.queries, run.spp, run.fit, offset).measure(study).command
        generate, fit = (shlex.split(part) for part in command.split(" && "))
        flags = {"--queries": "queries.train", "--spp": "queries.spp", "--seed": "seed"}
        assigned = [f"{flags[a]}={b}" for a, b in pairwise(generate) if a in flags]
        found = resolve(GeneratorConfig, file=tmp_path / "generate.yaml", assignments=assigned)
        *_, data, fitted = used
        test = {"test": data.queries.test, "test_spp": data.queries.test_spp}
        assert found.model_copy(update={"queries": found.queries.model_copy(update=test)}) == data
        options = [b for a, b in pairwise(fit) if a == "--set"]
        assert resolve(FitConfig, assignments=options) == fitted

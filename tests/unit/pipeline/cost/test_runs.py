"""Runs of a cost study: which are planned, what they take and leave, and commands that reproduce them."""

from __future__ import annotations

import shlex
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mbtf_fit
from mbtf_core.config.settings import resolve
from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.files.atomic import write_text
from mbtf_fit.config import FitConfig
from mbtf_fit.data.queries import ShardQueries
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.cost import runs as module
from mbtf_pipeline.cost.fit_runs import GENERATOR, RUNS, SHORTEST, planned_runs
from mbtf_pipeline.cost.runs import DataRequest, Run, RunRunner

FIT = {"model": "neumip", "training": {"time": "5s"}}


@pytest.mark.parametrize("seconds", [300.0, 600.0, 3600.0])
def test_planned_runs_fit_into_the_time_twice(seconds: float) -> None:
    found = planned_runs(seconds, 4, 7.5e-7)
    spent = sum(
        7.5e-7 * run.data.queries * run.data.spp + float(run.fit["training"]["time"].rstrip("s"))
        for run in found
    )
    assert 0.5 * RUNS * seconds / 2 < spent <= 1.1 * RUNS * seconds / 2
    assert GENERATOR + RUNS < 0.9
    assert all(run.data.seed == 0 for run in found)
    assert len({str(run.key) for run in found}) == len(found)
    # Total times double, so that a longer study keeps the runs of a shorter one.
    longer = planned_runs(2 * seconds, 4, 7.5e-7)
    doubling = [run for run in found if "35 %" in run.series]
    assert all(run in longer for run in doubling)
    assert [run.name for run in doubling] == [
        f"planned for {SHORTEST * 2**n:g} s" for n in range(len(doubling))
    ]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Generating takes seven seconds, fitting five, one more to load; evaluating 2¹⁸ queries half a second.
    The fit answers with a constant 0.1 where values are 0 and 1."""
    found = SimpleNamespace(now=0.0, perf_counter=lambda: found.now)

    class Material:
        def predict(self, queries: Any) -> Any:
            return np.full((len(queries), 3), 0.1, np.float32)

        def evaluate(self, u: Any, *_: Any) -> None:
            assert len(u) == 1 << 18
            found.now += 0.5

    def generate(config: GeneratorConfig, folder: Path, job: Any = None) -> None:
        found.now += 7.0

    def fit(config: Any, shards: Path, out: Path) -> Any:
        found.now += 6.0
        out.mkdir(parents=True)
        (out / "weights.safetensors").write_bytes(bytes(100))
        return SimpleNamespace(material=Material(), seconds=5.0, total_seconds=6.0)

    monkeypatch.setattr(module, "generate", generate)
    monkeypatch.setattr(module, "Job", SimpleNamespace(load=lambda config: SimpleNamespace(config=config)))
    monkeypatch.setattr(module, "time", found)
    monkeypatch.setattr(mbtf_fit, "fit", fit)
    return found


def runner(folder: Path, seed: int = 0, **options: Any) -> RunRunner:
    config = GeneratorConfig(material="m", seed=seed)
    made = RunRunner(
        config, folder, f"mbtf-gen m --config {folder / 'generate.yaml'}", lambda note: None, **options
    )
    value = np.repeat(np.arange(1000) % 2.0, 3).reshape(1000, 3).astype(np.float32)
    zero = np.zeros((1000, 3), np.float32)
    made.test_sets = dict.fromkeys((0, 2), ShardQueries(zero[:, :2], zero[:, 0], zero, zero, value, value))
    return made


def test_a_run_measures_time_and_error(clock: Any, tmp_path: Path) -> None:
    found = runner(tmp_path).measure(Run("whole", "", "", DataRequest(640, 4), FIT))
    assert found.seconds.value == 13.0
    d = found.details
    assert (d["generation_seconds"], d["training_seconds"], d["total_seconds"]) == (7, 5, 13)
    assert (d["queries"], d["spp"], d["bytes"]) == (640, 4, 100)
    assert d["evaluation_ms_1080p"] == pytest.approx(500 * 1920 * 1080 / 2**18)
    # Mean squares of 0.1 and 0.9 over the variance of a quarter.
    assert found.error.value == pytest.approx((0.01 + 0.81) / 2 / (0.25 * 1000 / 999), rel=1e-5)
    assert 0 < found.error.error < 0.1 * found.error.value


def test_seeds_change_data_and_fit(clock: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []
    usual = mbtf_fit.fit
    monkeypatch.setattr(module, "generate", lambda job, folder: seeds.append(job.config.seed))
    monkeypatch.setattr(
        mbtf_fit, "fit", lambda config, *rest: seeds.append(config.seed) or usual(config, *rest)
    )
    one = runner(tmp_path, seed=5)
    for seed in (0, 2):
        one.measure(Run("whole", "", "", DataRequest(64, 4, seed), FIT))
    assert seeds == [5, 5, 7, 7]


@pytest.mark.parametrize(("study_seed", "offset"), [(0, 0), (0, 2), (5, 0), (5, 2)])
def test_commands_reproduce_their_run(
    clock: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, study_seed: int, offset: int
) -> None:
    """The programs resolve the command to the configurations that were measured."""
    used: list[Any] = []
    monkeypatch.setattr(module, "generate", lambda job, folder: used.append(job.config))
    usual = mbtf_fit.fit
    monkeypatch.setattr(mbtf_fit, "fit", lambda config, *rest: used.append(config) or usual(config, *rest))
    one = runner(tmp_path, study_seed)
    write_text(tmp_path / "generate.yaml", dump_yaml(one.config.model_dump(mode="json")))
    runs = planned_runs(600.0, 6, 1.5e-7)
    for run in (runs[0], runs[-1]):
        used.clear()
        data = DataRequest(run.data.queries, run.data.spp, offset)
        command = one.measure(Run("whole", "", "", data, run.fit)).command
        generate, fit = (shlex.split(part) for part in command.split(" && "))
        flags = {"--queries": "queries.train", "--spp": "queries.spp", "--seed": "seed"}
        assigned = [f"{flags[a]}={b}" for a, b in pairwise(generate) if a in flags]
        found = resolve(GeneratorConfig, file=tmp_path / "generate.yaml", assignments=assigned)
        test = {"test": used[0].queries.test, "test_spp": used[0].queries.test_spp}
        assert found.model_copy(update={"queries": found.queries.model_copy(update=test)}) == used[0]
        options = [b for a, b in pairwise(fit) if a == "--set"]
        assert resolve(FitConfig, assignments=options) == used[1]


def test_every_seed_has_one_test_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[GeneratorConfig] = []
    monkeypatch.setattr(module, "generate", lambda job, folder: asked.append(job.config))
    monkeypatch.setattr(module, "Job", SimpleNamespace(load=lambda config: SimpleNamespace(config=config)))
    monkeypatch.setattr("mbtf_core.data.dataset.Dataset.open", lambda folder: folder)
    monkeypatch.setattr("mbtf_fit.data.loader.load_split", lambda data, split: split)
    one = runner(tmp_path, 3, test=(1 << 17, 8))
    one.test_sets = {}
    for seed in (0, 1, 0, 1, 2, 0, 2):
        assert one.test_set(seed) == "test"
    assert [config.seed for config in asked] == [3, 4, 5]
    assert {(c.queries.test, c.queries.test_spp) for c in asked} == {(str(1 << 17), 8)}

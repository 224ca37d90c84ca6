"""Runs of a cost study on workers: those of one process, each measured once, within the time of all."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from support.fake_runs import FakeRunner, MemoryStore, run

from mbtf_core.errors import InputError
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item, Result, packed, run_task
from mbtf_core.stats import Estimate
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.cost import distribute
from mbtf_pipeline.cost.distribute import ClusterRunner, measure_configurations, worker_facts
from mbtf_pipeline.cost.generator_runs import GeneratorTask
from mbtf_pipeline.cost.measurements import Measurement
from mbtf_pipeline.cost.repeats import MOST_SEEDS, measure_runs
from mbtf_pipeline.cost.runs import Run, RunRunner

CONFIG = GeneratorConfig.model_validate({"material": "m", "seed": 5})
RUNS = [run(3000, "long", 9.0), run(2000, "one"), run(2000, "two")]
ONE = Estimate(1.0, 0.1, 4)


class Workers(Runner):
    """Takes all items, and ends the last first."""

    workers = 2
    here = False

    def __init__(self) -> None:
        self.names: list[str] = []

    def map(self, function: Any, items: Iterable[Item], **options: Any) -> Iterator[Result]:  # type: ignore[override]
        for item in reversed(list(items)):
            self.names.append(item.name)
            yield Result(item.name, **run_task(*packed(function, item)))


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[tuple[str, int]]:
    """Name and seed of all runs that workers measure; the error follows from both."""
    found: list[tuple[str, int]] = []

    def measure(self: RunRunner, run: Run) -> Measurement:
        assert self.config == CONFIG
        assert not isinstance(self, ClusterRunner)
        if run.name == "diverges":
            raise InputError("training diverged at step 7")
        found.append((run.name, run.data.seed))
        if run.data.seed not in self.test_sets:
            self.test_sets[run.data.seed], self.test_seconds = None, 0.25  # type: ignore[assignment]
        error = Estimate(0.1 + 0.03 * run.data.seed + 0.01 * len(run.name), 0.001, 9)
        return Measurement(run.study, run.series, run.name, self.command, ONE, error, details={"x": 1.0})

    distribute._runner.cache_clear()
    monkeypatch.setattr(RunRunner, "measure", measure)
    return found


def cluster_runner(folder: Path, **options: Any) -> tuple[ClusterRunner, Workers]:
    workers: Any = Workers()
    return ClusterRunner(CONFIG, folder, "mbtf-gen m", lambda note: None, runner=workers, **options), workers


def test_workers_measure_the_runs_of_one_process(measured: list[tuple[str, int]], tmp_path: Path) -> None:
    runs = [*RUNS, run(900, "diverges")]
    plain = RunRunner(CONFIG, tmp_path, "mbtf-gen m", lambda note: None)
    expected = measure_runs(runs, MemoryStore(), plain, lambda run: True, MOST_SEEDS)  # type: ignore[arg-type]
    assert {len(group) for group in expected[0]} == {0, MOST_SEEDS}
    in_order, store = sorted(measured), MemoryStore()
    measured.clear()
    runner, workers = cluster_runner(tmp_path)
    found = measure_runs(runs, store, runner, lambda run: True, MOST_SEEDS)  # type: ignore[arg-type]
    assert found == expected
    assert sorted(measured) == in_order
    assert len(workers.names) == len(set(workers.names))
    # Nothing is measured again.
    measured.clear()
    assert measure_runs(runs[:3], store, runner, lambda run: True, 2)[0] == [g[:] for g in expected[0][:3]]  # type: ignore[arg-type]
    assert not measured


def test_workers_begin_what_fits_into_the_time_of_all(
    measured: list[tuple[str, int]], tmp_path: Path
) -> None:
    runner, _ = cluster_runner(tmp_path, path_seconds=1e-6, test=(1000, 10))
    # Two workers for 20 s, less two test sets each; a run takes 9 or 5 s of training and 2 s besides.
    assert runner.work_left(20.0) == pytest.approx(40.0 - 4 * 0.01)
    measure_runs(
        RUNS,
        MemoryStore(),  # type: ignore[arg-type]
        runner,
        lambda run: runner.work_left(20.0) > runner.expected_seconds(run),
        2,
    )
    assert sorted(measured) == [("long", 0), ("long", 1), ("one", 0), ("one", 1)]
    # What has ended takes no more time. The workers, here one process, made two test sets, in 0.25 s each.
    assert runner.work_left(20.0) == pytest.approx(40.0 - 2 * 0.25)


def test_workers_measure_configurations_of_the_generator(monkeypatch: pytest.MonkeyPatch) -> None:
    tasks = [GeneratorTask("paths", "uniform", f"{n}", {"queries.spp": n}, None) for n in (2, 4)]

    def measure(task: GeneratorTask, benchmark: Any, seconds: float, command: str) -> Measurement:
        assert (benchmark, seconds) == ("benchmark", 3.0)
        return Measurement(task.study, task.series, task.name, command, ONE, ONE)

    monkeypatch.setattr(GeneratorTask, "run", measure)
    monkeypatch.setattr(distribute, "_benchmark", lambda config: "benchmark")
    cluster: Any = Workers()
    found = list(measure_configurations(cluster, CONFIG, tasks, 3.0, "mbtf-gen m"))
    assert {task.name: one.command for task, one in found} == {
        "2": "mbtf-gen m --set queries.spp=2 -o shards/",
        "4": "mbtf-gen m --set queries.spp=4 -o shards/",
    }


def test_a_study_is_of_the_machine_of_its_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distribute, "forecast_seconds", lambda config: 8e-6)
    monkeypatch.setenv("MBTF_WORKER_THREADS", "1")
    cluster: Any = Workers()
    machine, seconds = worker_facts(cluster, CONFIG)
    assert machine["system"].endswith("workers of 1 thread")
    assert seconds == 8e-6 / CONFIG.queries.spp


def test_the_fake_runner_fails_like_the_real_one() -> None:
    runner = FakeRunner()
    runner.failing = {"one"}
    found = {number: result for number, _, result in runner.measure_all(enumerate(RUNS))}
    assert found[1] == "training diverged at step 7"
    assert isinstance(found[2], Measurement)

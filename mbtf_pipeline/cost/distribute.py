"""Measurements of a cost study on the workers of a cluster: a task is one configuration, with one seed.

A worker generates data and fits as a process of its own would, and measures the time itself, so that all
figures are of the workers' machine and threads. It keeps the test sets for its next run.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from mbtf_core.errors import PartialError
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item, worker_threads
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.cost.generator_runs import GeneratorTask
from mbtf_pipeline.cost.measurements import Measurement
from mbtf_pipeline.cost.repeats import FEWEST_SEEDS
from mbtf_pipeline.cost.runs import Run, RunRunner, forecast_seconds
from mbtf_pipeline.run_folder import machine

_RESUMES = "the same command resumes"


def worker_facts(runner: Runner, config: GeneratorConfig) -> tuple[dict[str, str], float]:
    """Record of the workers' machine, and their seconds per path of a training query by a forecast.

    Raises
    ------
    InputError : a worker does not see the material
    PartialError : no worker answered
    """
    (done,) = runner.map(describe_worker, [Item("forecast", {"config": config})])
    if done.error:
        raise PartialError(f"the forecast failed: {done.error}", hint=_RESUMES)
    return done.value["machine"], float(done.value["path_seconds"])


def describe_worker(config: GeneratorConfig) -> dict[str, Any]:
    """What :func:`worker_facts` returns; a task."""
    found = machine()
    if (threads := worker_threads()) is not None:
        found["system"] += f", workers of {threads} thread{'s' * (threads != 1)}"
    return {"machine": found, "path_seconds": forecast_seconds(config) / config.queries.spp}


def measure_configurations(
    runner: Runner, config: GeneratorConfig, tasks: Iterable[GeneratorTask], seconds: float, generator: str
) -> Iterator[tuple[GeneratorTask, Measurement]]:
    """Measure configurations of the generator for at most so many seconds each of noise and bias.

    Parameters
    ----------
    generator : str
        The generator's command with the study's configuration.

    Yields
    ------
    (GeneratorTask, Measurement)
        As they come; each task is taken once a worker is nearly free.

    Raises
    ------
    PartialError : a worker failed; finished measurements are kept
    """
    by_name: dict[str, GeneratorTask] = {}

    def given() -> Iterator[Item]:
        for number, task in enumerate(tasks):
            name = f"configuration-{number}"
            by_name[name] = task
            command = task.command(generator)
            yield Item(name, {"config": config, "seconds": seconds, "task": task, "command": command})

    for done in runner.map(measure_configuration, given(), ahead=0):
        task = by_name[done.name]
        if done.error:
            raise PartialError(f"{task.label} failed: {done.error}", hint=done.hint or _RESUMES)
        yield task, done.value


def measure_configuration(
    config: GeneratorConfig, seconds: float, task: GeneratorTask, command: str
) -> Measurement:
    """Measure one configuration of the generator; a task."""
    return task.run(_benchmark(config.model_dump_json()), seconds, command)


@lru_cache(maxsize=1)
def _benchmark(config: str) -> Any:
    """The benchmark of a study, kept for its references."""
    from mbtf_gen.job import Job
    from mbtf_pipeline.cost.generator_benchmark import GeneratorBenchmark

    job = Job.load(GeneratorConfig.model_validate_json(config))
    return GeneratorBenchmark(job.config, job.material)


@dataclass
class ClusterRunner(RunRunner):
    """Measures the runs of a study on the workers of a cluster.

    Attributes
    ----------
    runner : Runner
    """

    runner: Runner = field(default_factory=Runner)
    # Expected seconds of runs that have been taken, by name.
    _taken: dict[str, float] = field(default_factory=dict)
    # Test sets that the workers have yet to make, and seconds of one.
    _tests: int | None = None

    @property
    def _workers(self) -> int:
        return max(1, self.runner.workers)

    def work_left(self, seconds: float) -> float:
        """Seconds of work that the workers can begin and finish in a time."""
        if self._tests is None:
            queries, spp = self.test
            self._tests, self.test_seconds = FEWEST_SEEDS * self._workers, queries * spp * self.path_seconds
        return self._workers * seconds - self._tests * self.test_seconds - sum(self._taken.values())

    def measure_all(self, runs: Iterable[tuple[int, Run]]) -> Iterator[tuple[int, Run, Measurement | str]]:
        """As of the base class; a run is taken once a worker is nearly free."""
        by_name: dict[str, tuple[int, Run]] = {}

        def items() -> Iterator[Item]:
            for number, run in runs:
                name = f"run-{number}-{run.data.seed}"
                by_name[name] = number, run
                self._taken[name] = self.planned_seconds(run) + self.overhead
                arguments = {
                    "config": self.config,
                    "folder": self.folder,
                    "command": self.command,
                    "test": self.test,
                    "run": run,
                }
                yield Item(name, arguments, gpu=run.fit.get("device") == "cuda")

        for done in self.runner.map(measure_run, items(), independent=True, ahead=0):
            number, run = by_name[done.name]
            del self._taken[done.name]
            self.progress(run.label)
            if done.error:
                yield number, run, done.error
                continue
            self.overhead = max(self.overhead, done.value["overhead"])
            if done.value["test_seconds"] is not None:
                self.test_seconds = done.value["test_seconds"]
                self._tests = max(0, (self._tests or 0) - 1)
            yield number, run, done.value["measurement"]

    def expected_seconds(self, run: Run) -> float:
        """Expected time of measuring a run, in which a worker generates its data."""
        return self.planned_seconds(run) + self.overhead


def measure_run(
    config: GeneratorConfig, folder: Path, command: str, test: tuple[int, int], run: Run
) -> dict[str, Any]:
    """Measure one run; a task.

    Parameters
    ----------
    config : GeneratorConfig
    folder : Path
        Folder of the study's data and fits, of which this process gets one of its own.
    command : str
        The generator's, with the study's configuration.
    test : (int, int)
        Number of test queries, and paths of each.
    run : Run

    Returns
    -------
    dict
        ``measurement``, ``overhead`` (seconds besides generating and training, the most so far), and
        ``test_seconds`` (of the test set, None unless this call made it).

    Raises
    ------
    InputError
        The fit diverged.
    PartialError
        The disk is full.
    """
    runner = _runner(config.model_dump_json(), folder, command, test)
    known = run.data.seed in runner.test_sets
    found = runner.measure(run)
    seconds = None if known else runner.test_seconds
    return {"measurement": found, "overhead": runner.overhead, "test_seconds": seconds}


@lru_cache(maxsize=1)
def _runner(config: str, folder: Path, command: str, test: tuple[int, int]) -> RunRunner:
    """The runner of a study in this process, with its test sets."""
    own = folder / f"{socket.gethostname()}-{os.getpid()}"
    loaded = GeneratorConfig.model_validate_json(config)
    return RunRunner(loaded, own, command, lambda note: None, test=test)

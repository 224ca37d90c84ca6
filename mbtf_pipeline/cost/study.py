"""A cost study: measures what accuracy costs within a given time, and resumes where it stopped."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.shard_files import row_bytes
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_json, write_json, write_text
from mbtf_core.files.folders import ELSEWHERE, OutputKind, check_space, owned
from mbtf_core.run.runner import Runner
from mbtf_core.stats import Estimate, signal_variance
from mbtf_core.units import expectation
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job
from mbtf_pipeline.cost.distribute import ClusterRunner, measure_configurations, worker_facts
from mbtf_pipeline.cost.fit_runs import GENERATOR, planned_runs
from mbtf_pipeline.cost.generator_benchmark import GeneratorBenchmark
from mbtf_pipeline.cost.generator_runs import GeneratorTask, generator_tasks
from mbtf_pipeline.cost.measurements import Measurement, MeasurementFolder
from mbtf_pipeline.cost.repeats import FEWEST_SEEDS, MOST_SEEDS, combined, measure_runs, seed_deviation
from mbtf_pipeline.cost.runs import TEST, Run, RunRunner, forecast_seconds
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run_folder import machine

STUDY = OutputKind("study.json", "mbtf-cost", 2, "a cost study")
CONFIG_NAME = "generate.yaml"
WORK = ".work"
# Time of a new study, seconds.
NEW_TIME = 600.0
# Relative standard deviation of the values below which a fit has nothing to learn.
_LEAST_VARIATION = 0.005
# About as many configurations of the generator share its time.
_CONFIGURATIONS = 35


@dataclass
class Study:
    """What a study has measured."""

    folder: Path
    # Name, command, time, seed, machine and date.
    description: dict[str, Any]
    # One per configuration.
    measurements: list[Measurement] = field(default_factory=list)
    # Relative standard deviation of runs over seeds, part of their error bars; None without repeats.
    deviation: Estimate | None = None
    # Configurations for which no time was left, and runs that failed, with the reason.
    skipped: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)


def claim(folder: Path, on: Mapping[str, str]) -> None:
    """Take an empty folder, or one that holds a study of the kind of machine that measures."""
    if not STUDY.check(folder):
        return
    there, here = read_json(folder / STUDY.record)["machine"]["system"], on["system"]
    if there != here:
        problem = f"holds a cost study of another kind of machine ({there}; this is {here})"
        raise InputError(problem, where=folder, hint=ELSEWHERE)


def time_of(folder: Path) -> float:
    """Time in seconds of the study in a folder; that of a new one where there is none."""
    found = STUDY.read(folder)
    return NEW_TIME if found is None else float(found["time"])


def _check_variation(benchmark: GeneratorBenchmark) -> None:
    """Refuse a material that gives a fit nothing to learn."""
    reference, where = benchmark.reference({}), benchmark.config.material
    if not reference.mean > 0:
        hint = "study a material with a base color or gloss"
        raise InputError("reflects nothing: every value is 0", where=where, hint=hint)
    variance = signal_variance(*reference.batch(0)[1])
    if variance.value + 2 * variance.error < (_LEAST_VARIATION * reference.mean) ** 2:
        problem = "reflects the same everywhere and in all directions: there is nothing to fit"
        raise InputError(problem, where=where, hint="study a material with displacement or textures")


def study_config(config: GeneratorConfig, seed: int | None) -> GeneratorConfig:
    """A recipe's generator as its study uses it: without a target error, which would override the numbers of
    paths, and with shuffled queries."""
    queries = config.queries.model_copy(update={"target_error": None, "layout": "shuffled"})
    seeds = {} if seed is None else {"seed": seed}
    return config.model_copy(update={"queries": queries, **seeds})


def run_study(
    recipe: Recipe,
    folder: Path,
    *,
    seconds: float,
    refine: float = 0.0,
    seed: int | None = None,
    command: str = "",
    progress: Callable[[float, str], None] = lambda share, note: None,
    announce: Callable[[str], None] = lambda text: None,
    runner: Runner | None = None,
) -> Study:
    """Measure what the time allows for the material and generator of a recipe; stored measurements are kept
    and cost no time.

    Parameters
    ----------
    refine : additional seconds for repeating runs with wide error bars
    seed : of queries, paths and initial weights; the recipe's by default
    progress : called with (share of the time spent, note)
    announce : called with expected time and size as a line, before anything is written
    runner : measures configurations and runs; its workers on their machines and with their threads
    """
    start = time.perf_counter()
    workers = None if runner is None or runner.here else runner

    def spent() -> float:
        return time.perf_counter() - start

    def note(text: str) -> None:
        progress(min(1.0, spent() / (seconds + refine)), text)

    config = study_config(recipe.generate, seed)
    job = Job.prepare(config)
    config, material = job.config, job.material
    with owned(folder):
        on, per_path = (machine(), None) if workers is None else worker_facts(workers, config)
        claim(folder, on)
        benchmark = GeneratorBenchmark(config, material)
        note("reference")
        # Before anything is written: a refused study leaves the folder as it was.
        _check_variation(benchmark)
        store = MeasurementFolder(folder, config.hash(material.digests))
        path = path_seconds(config, store, per_path)
        size = disk_bytes(planned_runs(seconds, config.queries.spp, path))
        size *= 1 if workers is None else workers.workers
        check_space(folder, size, "give a shorter --time, or choose another folder with -o")
        announce(expectation(seconds + refine, size))
        description = {
            "name": recipe.name,
            "command": command,
            "time": seconds,
            "seed": config.seed,
            "material": config.material,
            "date": time.strftime("%Y-%m-%d"),
            "machine": on,
        }
        STUDY.write(folder, description)
        write_text(folder / CONFIG_NAME, dump_yaml(config.model_dump(mode="json")))
        study = Study(folder, description)
        keep_path_seconds(store, path)
        generator = shlex.join(["mbtf-gen", config.material, "--config", str(folder / CONFIG_NAME)])
        each = 0.5 * GENERATOR * seconds / _CONFIGURATIONS
        tasks = list(generator_tasks(benchmark))
        found = {task.label: store.get(task, task.command(generator)) for task in tasks}

        # Configurations take longer than their share where kernels are compiled; workers start anew.
        until = 1.2 * GENERATOR * seconds + (0.0 if workers is None else spent())

        def missing() -> Iterator[GeneratorTask]:
            for task in tasks:
                if found[task.label] is None and spent() < until:
                    note(task.label)
                    yield task

        measured: Iterator[tuple[GeneratorTask, Measurement]]
        if workers is None:
            measured = ((task, task.run(benchmark, each, task.command(generator))) for task in missing())
        else:
            measured = measure_configurations(workers, config, missing(), each, generator)
        for task, measurement in measured:
            found[task.label] = measurement
            store.put(task, measurement)
        for label, known in found.items():
            if known is None:
                study.skipped.append(label)
            else:
                study.measurements.append(known)
        options: dict[str, Any] = {"path_seconds": path}
        if workers is None:
            runs = RunRunner(config, folder / WORK, generator, note, **options)
        else:
            runs = ClusterRunner(config, folder / WORK, generator, note, runner=workers, **options)
        try:
            seeds = MOST_SEEDS if refine else FEWEST_SEEDS
            _measure_runs(
                study,
                store,
                runs,
                lambda again: runs.work_left(seconds + again * refine - spent()),
                seeds,
            )
        finally:
            runs.clear()
    return study


def path_seconds(config: GeneratorConfig, store: MeasurementFolder, expected: float | None = None) -> float:
    """Seconds to generate a query over its number of paths; those stored, so that a resumed study plans the
    same runs, else those expected, by default the forecast of this machine."""
    try:
        return float(read_json(_seconds_file(store))["path_seconds"])
    except InputError:
        return forecast_seconds(config) / config.queries.spp if expected is None else expected


def keep_path_seconds(store: MeasurementFolder, seconds: float) -> None:
    """Store what :func:`path_seconds` then returns."""
    store.folder.mkdir(parents=True, exist_ok=True)
    write_json(_seconds_file(store), {"path_seconds": seconds})


def _seconds_file(store: MeasurementFolder) -> Path:
    return store.folder / f"seconds-{store.basis[:16]}.json"


def disk_bytes(runs: Sequence[Run]) -> int:
    """Disk space that runs take at most: the test set, and data of one seed."""
    most = max((run.data.queries for run in runs), default=0)
    return (TEST[0] + most) * row_bytes(holes=True)


def _measure_runs(
    study: Study, store: MeasurementFolder, runner: RunRunner, left: Callable[[bool], float], seeds: int
) -> None:
    """Measure runs in the remaining time, which is longer for repeats than for others."""
    runs = planned_runs(study.description["time"], runner.config.queries.spp, runner.path_seconds)

    def fits(run: Run) -> bool:
        return left(run.data.seed > 0) > runner.expected_seconds(run)

    groups, failed = measure_runs(runs, store, runner, fits, seeds)
    study.deviation = seed_deviation(groups)
    study.failed = list(failed.values())
    study.measurements += [combined(group, study.deviation) for group in groups if group]
    study.skipped += [run.label for k, run in enumerate(runs) if not groups[k] and k not in failed]

"""A cost study: measures what accuracy costs within a given time, and resumes where it stopped."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import count, takewhile
from pathlib import Path
from typing import Any

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.shard_files import row_bytes
from mbtf_core.errors import InputError, MbtfError, PartialError
from mbtf_core.files.atomic import read_json
from mbtf_core.files.editable import write_document
from mbtf_core.files.folders import ELSEWHERE, OutputKind, check_space, owned
from mbtf_core.run.task import failure
from mbtf_core.stats import Estimate
from mbtf_core.units import clock, format_duration, size_text
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.planning.job import Job
from mbtf_pipeline.cost.generator import benchmark_of, generator_configurations, path_seconds
from mbtf_pipeline.cost.measurement import (
    CONFIG_NAME,
    Conditions,
    Configuration,
    Measurement,
    MeasurementFolder,
    combined,
    seed_deviation,
)
from mbtf_pipeline.cost.runs import GENERATOR, RUNS_ALONE, TEST, Run, planned_runs, test_set
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.stages import machine
from mbtf_pipeline.tables import is_significant

STUDY = OutputKind("study.json", "mbtf-cost", 2, "a cost study")
# Seconds by which a run exceeds generating and training until one has been measured: of a short fit of the
# default model, 5 besides training, and 2 of its evaluation.
OVERHEAD = 7.0
# By how much the generator's configurations exceed their share, as kernels are compiled.
COMPILING = 1.2
RESUMES = "the same command resumes"


@dataclass
class Measurements:
    """The measurements of a study by the label of their configuration, stored as they come.

    Attributes
    ----------
    conditions, store : what a measurement needs, and where the results are kept
    note : called when a configuration is taken, with its label and the time that it is expected to take
    failed : why runs failed
    path_seconds, step_seconds : seconds of generating a query over its number of paths; of a training step
    """

    conditions: Conditions
    store: MeasurementFolder
    note: Callable[[str], None] = lambda label: None
    found: dict[str, Measurement] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    path_seconds: float = 0.0
    step_seconds: float = 0.0
    # Whether a run has made the test set.
    tested: bool = False
    # Seconds of measured runs besides the test set, generating and training.
    _besides: list[float] = field(default_factory=list)

    def plan_runs(self, seconds: float, spp: int) -> list[Run]:
        """The runs of a study: the first one, by whose steps the others are planned once it is measured."""
        first = planned_runs(0.0, spp, self.path_seconds)[0]
        if self.recall(first):
            self.step_seconds = _step_seconds(self.found[first.label])
        runs = planned_runs(seconds, spp, self.path_seconds, self.step_seconds)
        return runs if first in runs else [first, *runs]

    def recall(self, configuration: Configuration) -> bool:
        """Whether a measurement is stored; it then counts as found."""
        stored = self.store.get(configuration)
        if stored is not None:
            self._add(configuration, stored)
        return stored is not None

    def _add(self, configuration: Configuration, measurement: Measurement) -> None:
        if isinstance(configuration, Run) and configuration.label not in self.found:
            planned = configuration.planned_seconds(self.path_seconds, _step_seconds(measurement))
            self._besides.append(measurement.details["run_seconds"] - planned)
        self.found[configuration.label] = measurement

    def measure(self, wanted: Iterable[Configuration]) -> None:
        """Measure configurations, one after the other. A run that fails says nothing about the others, but an
        error of the generator is raised; a PartialError where the disk is full."""
        for configuration in wanted:
            label, left = configuration.label, ""
            if isinstance(configuration, Run):
                left = f", about {clock(self.expected_seconds(configuration))}"
            self.note(label + left)
            try:
                measured = configuration.measure(self.conditions)
            except PartialError as error:
                what = failure(error)["error"]
                raise PartialError(f"{label} failed: {what}", hint=error.hint or RESUMES) from None
            except MbtfError as error:
                if not isinstance(configuration, Run):
                    raise
                # The other runs are worth a page all the same.
                self.failed[label] = failure(error)["error"]
                continue
            self._add(configuration, measured)
            self.note(f"{label}: done")
            self.store.put(configuration, measured)
            self.tested = self.tested or isinstance(configuration, Run)

    def expected_seconds(self, run: Run) -> float:
        """Expected seconds of measuring a run, the first one with the test set."""
        planned = run.planned_seconds(self.path_seconds, self.step_seconds)
        test = 0.0 if self.tested else TEST[0] * TEST[1] * self.path_seconds
        # What runs have taken besides, at most.
        return planned + test + max(self._besides, default=OVERHEAD)

    def group(self, run: Run) -> list[Measurement]:
        """The measurements of a run with the first seeds, without gaps."""
        labels = (replace(run, seed=seed).label for seed in count())
        return [self.found[label] for label in takewhile(self.found.__contains__, labels)]

    def measure_runs(self, runs: Sequence[Run], fits: Callable[[Run], bool]) -> None:
        """Measure runs in their order, while they fit into the remaining time."""

        def missing() -> Iterator[Run]:
            for run in runs:
                failed = {run.label, replace(run, seed=0).label} & self.failed.keys()
                if not failed and not self.recall(run) and fits(run):
                    yield run

        self.measure(missing())


def _step_seconds(run: Measurement) -> float:
    return run.details["training_seconds"] / run.details["training_steps"]


@dataclass
class Study:
    """What a study has measured."""

    folder: Path
    # Name, command, planned time and time taken, seed, machine and date.
    description: dict[str, Any]
    # One per configuration.
    measurements: list[Measurement]
    # Relative standard deviation of runs over seeds, part of their error bars.
    deviation: Estimate
    # Configurations for which no time was left, and runs that failed, with the reason.
    skipped: list[str]
    failed: list[str]

    @property
    def runs(self) -> list[Measurement]:
        """Measurements of complete runs."""
        return [m for m in self.measurements if m.study == "run"]

    @property
    def more(self) -> str:
        """What a longer study is needed for, in one sentence; empty where this one suffices."""
        longer = f"repeat the command with --time {format_duration(2.0 * self.description['time'])}"
        if not self.runs:
            return f"no complete run fits into the time: {longer}"
        uncertain = sum(not is_significant(run.error) for run in self.runs)
        return f"errors of {uncertain} runs are not significant: {longer}" if uncertain else ""


def study_config(config: GeneratorConfig) -> GeneratorConfig:
    """A recipe's generator as its study uses it: without a target error, which would override the numbers of
    paths, and with shuffled queries that share no paths."""
    own = {"target_error": None, "layout": "shuffled", "lights_per_path": 1}
    return config.model_copy(update={"queries": config.queries.model_copy(update=own)})


def claim(folder: Path) -> None:
    """Take an empty folder, or one that holds a study of this kind of machine."""
    if not STUDY.check(folder):
        return
    there, here = read_json(folder / STUDY.record)["machine"]["system"], machine()["system"]
    if there != here:
        problem = f"holds a cost study of another kind of machine ({there}; this is {here})"
        raise InputError(problem, where=folder, hint=ELSEWHERE)


def run_study(
    recipe: Recipe,
    folder: Path,
    *,
    seconds: float,
    command: str = "",
    progress: Callable[[float, str], None] = lambda share, note: None,
    announce: Callable[[str], None] = lambda text: None,
) -> Study:
    """Measure what the time allows for the material and generator of a recipe; stored measurements are kept
    and cost no time.

    Parameters
    ----------
    seconds : time of the study
    command : for the page
    progress, announce : called with (share of the time spent, note), and with lines for the user

    Raises
    ------
    InputError : the folder holds something else, there is nothing to fit, or the disk is too small
    PartialError : the disk is full; finished measurements are kept
    """
    start = time.perf_counter()

    def spent() -> float:
        return time.perf_counter() - start

    def note(text: str) -> None:
        progress(min(1.0, spent() / seconds), text)

    job = Job.load(study_config(recipe.generate))
    config = job.config
    with owned(folder):
        claim(folder)
        conditions = Conditions.of(job, folder, GENERATOR * seconds)
        note("reference, which compiles the kernels")
        # Before anything is written: a refused study leaves the folder as it was.
        benchmark_of(conditions).check_variation()
        description = {
            "name": recipe.name,
            "command": command,
            "time": seconds,
            "seed": config.seed,
            "material": config.material,
            "date": time.strftime("%Y-%m-%d"),
            "machine": machine(),
        }
        STUDY.write(folder, description)
        write_document(folder / CONFIG_NAME, dump_yaml(config.model_dump(mode="json")))
        measurements = Measurements(conditions, MeasurementFolder(folder, conditions), note)
        found = measurements.found
        configurations = list(generator_configurations(benchmark_of(conditions)))
        until = COMPILING * GENERATOR * max(0.0, seconds - RUNS_ALONE)

        def missing() -> Iterator[Configuration]:
            for number, configuration in enumerate(configurations):
                if not measurements.recall(configuration) and (number == 0 or spent() < until):
                    yield configuration

        try:
            measurements.measure(missing())
            spp = config.queries.spp
            generator = [found[c.label] for c in configurations if c.label in found]
            measurements.path_seconds = path_seconds(generator, spp)
            runs = measurements.plan_runs(seconds, spp)
            # The test set, and the data of one run.
            size = (TEST[0] + max(run.queries for run in runs)) * row_bytes(holes=True)
            check_space(folder, size, "give a shorter --time, or choose another folder with -o")
            announce(f"expected: about {clock(seconds)}, {size_text(size)} on disk")

            def fits(run: Run) -> bool:
                return seconds - spent() > measurements.expected_seconds(run)

            # The first run measures how long runs and training steps take here.
            measurements.measure_runs(runs[:1], fits)
            runs = measurements.plan_runs(seconds, spp)
            measurements.measure_runs(runs, fits)
            description["taken"] = spent()
            STUDY.write(folder, description)
        finally:
            shutil.rmtree(conditions.folder, ignore_errors=True)
            for kept in (benchmark_of, test_set):
                kept.cache_clear()
    progress(1.0, "finished")
    first = [run for run in runs if run.seed == 0]
    groups = [measurements.group(run) for run in first]
    deviation = seed_deviation(groups)
    complete = [combined(group, deviation) for group in groups if group]
    failed = measurements.failed
    return Study(
        folder,
        description,
        generator + sorted(complete, key=lambda m: m.seconds.value),
        deviation,
        [c.label for c in (*configurations, *first) if c.label not in found and c.label not in failed],
        [f"{label}: {why}" for label, why in failed.items()],
    )

"""A cost study: measures what accuracy costs within a given time, and resumes where it stopped.

Measurements are tasks: this process does them one after the other, the workers of a cluster each for itself.
A worker generates data and fits as a process of its own would, and measures the time itself, so that all
figures are of the workers' machine and threads.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.errors import InputError, PartialError
from mbtf_core.files.atomic import read_json
from mbtf_core.files.editable import write_document
from mbtf_core.files.folders import ELSEWHERE, OutputKind, check_space, owned
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item
from mbtf_core.stats import Estimate
from mbtf_core.units import clock, expectation, format_duration, rounded_duration
from mbtf_gen.job import Job
from mbtf_pipeline.cost.answers import Evidence
from mbtf_pipeline.cost.conditions import (
    CONFIG_NAME,
    conditions_of,
    generator_seconds,
    measuring_machine,
    study_config,
)
from mbtf_pipeline.cost.generator import benchmark_of, generator_configurations, path_seconds
from mbtf_pipeline.cost.measurement import (
    HALF_WIDTH,
    NORMAL,
    Conditions,
    Configuration,
    Measurement,
    MeasurementFolder,
    combined,
    measure,
    seed_deviation,
)
from mbtf_pipeline.cost.runs import (
    FEWEST_TOTALS,
    GENERATOR,
    LEAST_SECONDS,
    MOST_SEEDS,
    SHORTEST,
    SLOW_SERIES,
    TEST,
    Run,
    disk_bytes,
    planned_runs,
    shortest_total,
    test_set,
)
from mbtf_pipeline.recipe import Recipe

STUDY = OutputKind("study.json", "mbtf-cost", 2, "a cost study")
# Seconds by which a run exceeds generating and training, until one has been measured.
OVERHEAD = 12.0
# By how much the generator's configurations exceed their share, as kernels are compiled.
_COMPILING = 1.2
_RESUMES = "the same command resumes"


@dataclass
class Study:
    """What a study has measured."""

    folder: Path
    # Name, command, planned time and time taken, seed, machine and date.
    description: dict[str, Any]
    # One per configuration.
    measurements: list[Measurement] = field(default_factory=list)
    # Relative standard deviation of runs over seeds, part of their error bars.
    deviation: Estimate = field(default_factory=lambda: seed_deviation([]))
    # Configurations for which no time was left, and runs that failed, with the reason.
    skipped: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    # Forecast of the error that was asked for.
    asked: str = ""
    # Seconds of a study that measures a run, and of one that forecasts; None where this one does.
    least_run: float | None = None
    least: float | None = None

    @cached_property
    def evidence(self) -> Evidence:
        """What the complete runs say of other times and errors."""
        return Evidence.of(self.measurements, self.deviation)

    @property
    def more(self) -> str:
        """Which longer study would measure a run or forecast, in one sentence; empty where this one does."""
        if self.least is None:
            return ""
        if self.least_run is not None:
            return no_run(self.least_run, self.least)
        enough = self.least <= self.description["time"]
        how = "the same command" if enough else f"the command with --time {rounded_duration(self.least)}"
        return f"too few complete runs for a forecast: repeat {how}; it keeps these runs and adds others"


def claim(folder: Path, on: Mapping[str, str]) -> None:
    """Take an empty folder, or one that holds a study of the kind of machine that measures."""
    if not STUDY.check(folder):
        return
    there, here = read_json(folder / STUDY.record)["machine"]["system"], on["system"]
    if there != here:
        problem = f"holds a cost study of another kind of machine ({there}; this is {here})"
        raise InputError(problem, where=folder, hint=ELSEWHERE)


def no_run(least_run: float, least: float) -> str:
    """That a study has no time for a complete run, and the times of those that have."""
    return (
        f"no complete run fits into the time: one takes --time {rounded_duration(least_run)}, and a forecast "
        f"--time {rounded_duration(least)}"
    )


def too_short(seconds: float, least: float) -> str:
    """Warning of a study that is too short for forecasts."""
    return (
        f"warning: --time {format_duration(seconds)} measures errors, but is too short to forecast others: "
        f"complete runs of {FEWEST_TOTALS} lengths take about {rounded_duration(least)} on this machine"
    )


@dataclass
class Measurements:
    """The measurements of a study by the label of their configuration, stored as they come.

    Attributes
    ----------
    conditions, store, runner : what measures, and where the results are kept
    note : called when a configuration is taken, with its label and the time that it is expected to take
    failed : why runs failed
    path_seconds, step_seconds : seconds of generating a query over its number of paths; of a training step
    share : share of the processors that other work leaves
    """

    conditions: Conditions
    store: MeasurementFolder
    runner: Runner
    note: Callable[[str], None] = lambda label: None
    found: dict[str, Measurement] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    path_seconds: float = 0.0
    step_seconds: float = 0.0
    share: float = 1.0
    # Taken, but not measured yet.
    _pending: dict[str, Configuration] = field(default_factory=dict)
    # Whether a run has made the test set.
    tested: bool = False
    # Seconds of measured runs besides the test set, generating and training.
    _besides: list[float] = field(default_factory=list)

    @property
    def overhead(self) -> float:
        """Seconds that a run takes besides the test set, generating and training, at most."""
        return max(self._besides, default=OVERHEAD / self.share)

    @cached_property
    def configurations(self) -> list[Configuration]:
        """Those of the generator, the most important first."""
        return list(generator_configurations(benchmark_of(self.conditions)))

    def of_generator(self) -> list[Measurement]:
        """Measurements of the generator's configurations."""
        return [self.found[c.label] for c in self.configurations if c.label in self.found or self.recall(c)]

    def recall_rate(self, spp: int) -> bool:
        """Set `path_seconds` by what is measured of the generator with about so many paths; whether any
        is."""
        found = self.of_generator()
        if found:
            self.path_seconds = path_seconds(found, spp)
        return bool(found)

    def plan_runs(self, seconds: float, spp: int) -> list[Run]:
        """The runs of a study: the first one, by whose steps the others are planned once it is measured."""
        first = planned_runs(0.0, spp, self.path_seconds)[0]
        if self.recall(first):
            self.step_seconds = _step_seconds(self.found[first.label])
        runs = planned_runs(seconds, spp, self.path_seconds, self.step_seconds)
        # With its few queries it follows another law than the others.
        return runs if first in runs else [replace(first, series=SLOW_SERIES), *runs]

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

    def measure(self, wanted: Iterable[Configuration], *, independent: bool) -> None:
        """Measure configurations; each is taken once a worker is nearly free.

        Parameters
        ----------
        wanted : iterable of Configuration
        independent : whether one that fails says nothing about the others

        Raises
        ------
        InputError : a configuration failed, which is not independent
        PartialError : a worker died, or the disk is full
        """

        def items() -> Iterator[Item]:
            for configuration in wanted:
                self._pending[configuration.label] = configuration
                left = ""
                if isinstance(configuration, Run):
                    left = f", about {clock(self.expected_seconds(configuration))}"
                self.note(configuration.label + left)
                arguments = {"configuration": configuration, "conditions": self.conditions}
                yield Item(configuration.label, arguments)

        for done in self.runner.map(measure, items(), independent=independent, ahead=0):
            configuration = self._pending.pop(done.name)
            if done.error and not done.fatal:
                raise PartialError(f"{done.name} failed: {done.error}", hint=done.hint or _RESUMES)
            if done.error:
                # The other runs are worth a page all the same.
                self.failed[done.name] = done.error
                continue
            self._add(configuration, done.value)
            self.note(f"{done.name}: done")
            self.store.put(configuration, done.value)
            self.tested = self.tested or isinstance(configuration, Run)

    @property
    def test_seconds(self) -> float:
        """Expected seconds of making the test set."""
        return TEST[0] * TEST[1] * self.path_seconds

    def expected_seconds(self, run: Run) -> float:
        """Expected seconds of measuring a run, the first one with the test set."""
        planned = run.planned_seconds(self.path_seconds, self.step_seconds)
        return planned + (0.0 if self.tested else self.test_seconds) + self.overhead

    def fitting(self, runs: Sequence[Run], before: float, seconds: float) -> tuple[list[Run], float]:
        """The runs that are not measured yet and are expected to fit into a time, after `before` seconds
        without runs; and the seconds of everything."""
        found, spent, test = list[Run](), before, 0.0 if self.tested else self.test_seconds
        for run in runs:
            after = spent + run.planned_seconds(self.path_seconds, self.step_seconds) + self.overhead + test
            if not self.recall(run) and after <= seconds:
                found.append(run)
                spent, test = after, 0.0
        return found, spent

    def least_seconds(self, spp: int, setup: float) -> float | None:
        """Seconds of a study that measures runs of enough lengths for a forecast, by what runs have taken on
        this machine, after `setup` seconds of loading and reference; None where they are measured."""
        enough = LEAST_SECONDS * shortest_total(self.step_seconds) / SHORTEST
        needed = planned_runs(enough, spp, self.path_seconds, self.step_seconds)[:FEWEST_TOTALS]
        missing = [run for run in needed if not self.recall(run)]
        return max(LEAST_SECONDS, self._study_seconds(missing, setup)) if missing else None

    def least_run_seconds(self, spp: int, setup: float) -> float | None:
        """Likewise of a study that measures one run; None where any is measured."""
        return (
            None if self._besides else self._study_seconds(planned_runs(0.0, spp, self.path_seconds), setup)
        )

    def _study_seconds(self, runs: Sequence[Run], setup: float) -> float:
        """Seconds of a study that has time for some runs, and makes the test set anew."""
        planned = (run.planned_seconds(self.path_seconds, self.step_seconds) for run in runs)
        needed = setup + self.test_seconds + sum(planned) + len(runs) * self.overhead
        # Of what exceeds the least time of all machines, the generator gets its share.
        share = _COMPILING * GENERATOR
        return max(needed, (needed - share * LEAST_SECONDS) / (1.0 - share))

    def fits(self, run: Run, seconds: float) -> bool:
        """Whether the workers can begin and finish a run in a time, besides those that they have taken."""
        taken = sum(self.expected_seconds(r) for r in self._pending.values() if isinstance(r, Run))
        return max(1, self.runner.workers) * seconds - taken > self.expected_seconds(run)

    def group(self, run: Run) -> list[Measurement]:
        """The measurements of a run with the first seeds, without gaps."""
        labels = (replace(run, seed=seed).label for seed in range(MOST_SEEDS))
        return [self.found[label] for label in takewhile(self.found.__contains__, labels)]

    def measure_runs(self, runs: Sequence[Run], fits: Callable[[Run], bool], seeds: int = 0) -> None:
        """Measure runs in their order, then, up to so many seeds, further seeds of those whose error bar over
        seeds is too wide, while they fit into the remaining time."""

        def missing(order: Iterable[Run], wanted: Callable[[Run], bool]) -> Iterator[Run]:
            for run in order:
                failed = {run.label, replace(run, seed=0).label} & self.failed.keys()
                if not failed and not self.recall(run) and wanted(run) and fits(run):
                    yield run

        self.measure(missing(runs, lambda run: True), independent=True)
        first = [run for run in runs if run.seed == 0]
        for seed in range(1, MOST_SEEDS):
            deviation = seed_deviation(self.group(run) for run in first)

            def wide(run: Run, deviation: float = deviation.value) -> bool:
                own = len(self.group(run))
                return own == run.seed < seeds and NORMAL * deviation / math.sqrt(own) > HALF_WIDTH

            self.measure(missing([replace(run, seed=seed) for run in first], wide), independent=True)


def _step_seconds(run: Measurement) -> float:
    return run.details["training_seconds"] / run.details["training_steps"]


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
    recipe : Recipe
    folder : Path
    seconds : float
    refine : float
        Additional seconds for repeating runs with wide error bars.
    seed : int, optional
        Of queries, paths and initial weights; the recipe's by default.
    command : str
        For the page.
    progress : callable
        Called with (share of the time spent, note).
    announce : callable
        Called with expected time and size as a line, before the first run.
    runner : Runner, optional
        Measures; its workers on their machines and with their threads. This process by default.

    Returns
    -------
    Study

    Raises
    ------
    InputError
        The folder holds something else, there is nothing to fit, or the disk is too small.
    PartialError
        A worker died, or the disk is full; finished measurements are kept.
    """
    start = time.perf_counter()
    runner = runner or Runner()

    def spent() -> float:
        return time.perf_counter() - start

    def note(text: str) -> None:
        progress(min(1.0, spent() / (seconds + refine)), text)

    job = Job.load(study_config(recipe.generate, seed))
    config = job.config
    with owned(folder):
        (there,) = runner.map(measuring_machine, [Item("machine")])
        if there.error:
            raise PartialError(f"no worker answers: {there.error}", hint=there.hint or _RESUMES)
        claim(folder, there.value)
        conditions = conditions_of(job, folder, seconds)
        note("reference, which compiles the kernels")
        # Before anything is written: a refused study leaves the folder as it was.
        benchmark_of(conditions).check_variation()
        description = {
            "name": recipe.name,
            "command": command,
            "time": seconds + refine,
            "seed": config.seed,
            "material": config.material,
            "date": time.strftime("%Y-%m-%d"),
            "machine": there.value,
        }
        setup = description["setup_seconds"] = spent()
        STUDY.write(folder, description)
        write_document(folder / CONFIG_NAME, dump_yaml(config.model_dump(mode="json")))
        measurements = Measurements(conditions, MeasurementFolder(folder, conditions), runner, note)
        configurations = measurements.configurations
        # Configurations take longer than their share where kernels are compiled; workers start anew.
        until = _COMPILING * generator_seconds(seconds) + (0.0 if runner.here else spent())

        def missing() -> Iterator[Configuration]:
            for number, configuration in enumerate(configurations):
                if not measurements.recall(configuration) and (number == 0 or spent() < until):
                    yield configuration

        try:
            measurements.measure(missing(), independent=False)
            spp = config.queries.spp
            measurements.recall_rate(spp)
            runs = measurements.plan_runs(seconds, spp)
            size = disk_bytes(runs) * runner.workers
            check_space(folder, size, "give a shorter --time, or choose another folder with -o")
            _, expected = measurements.fitting(runs, spent(), seconds)
            announce(expectation((expected if runner.here else seconds) + refine, size))

            def fits(run: Run) -> bool:
                return measurements.fits(run, seconds + (refine if run.seed else 0.0) - spent())

            # The first run measures how long runs and training steps take here.
            measurements.measure_runs(runs[:1], fits)
            runs = measurements.plan_runs(seconds, spp)
            least = measurements.least_seconds(spp, setup)
            if least is not None and seconds < least:
                announce(too_short(seconds, least))
            measurements.measure_runs(runs, fits, MOST_SEEDS if refine else 0)
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
    known, failed = measurements.found, measurements.failed
    return Study(
        folder,
        description,
        measurements.of_generator() + [combined(group, deviation) for group in groups if group],
        deviation,
        [c.label for c in (*configurations, *first) if c.label not in known and c.label not in failed],
        [f"{label}: {why}" for label, why in failed.items()],
        least_run=measurements.least_run_seconds(spp, setup),
        least=measurements.least_seconds(spp, setup),
    )

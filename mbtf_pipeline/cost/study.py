"""A cost study: measures what accuracy costs within a given time, and resumes where it stopped."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_json
from mbtf_core.files.editable import write_document
from mbtf_core.files.folders import ELSEWHERE, OutputKind, check_space, owned
from mbtf_core.stats import Estimate
from mbtf_core.units import clock, format_duration, size_text
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job
from mbtf_pipeline.cost.generator import benchmark_of
from mbtf_pipeline.cost.measurement import (
    CONFIG_NAME,
    Conditions,
    Configuration,
    Measurement,
    MeasurementFolder,
    combined,
    seed_deviation,
)
from mbtf_pipeline.cost.runs import GENERATOR, Run, disk_bytes, test_set
from mbtf_pipeline.cost.schedule import COMPILING, Measurements, generator_seconds
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.stages import machine
from mbtf_pipeline.tables import is_significant

STUDY = OutputKind("study.json", "mbtf-cost", 2, "a cost study")


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
        configurations = measurements.configurations
        # Configurations take longer than their share where kernels are compiled.
        until = COMPILING * generator_seconds(seconds)

        def missing() -> Iterator[Configuration]:
            for number, configuration in enumerate(configurations):
                if not measurements.recall(configuration) and (number == 0 or spent() < until):
                    yield configuration

        try:
            measurements.measure(missing(), independent=False)
            spp = config.queries.spp
            measurements.recall_rate(spp)
            runs = measurements.plan_runs(seconds, spp)
            size = disk_bytes(runs)
            check_space(folder, size, "give a shorter --time, or choose another folder with -o")
            announce(f"expected: about {clock(seconds)}, {size_text(size)} on disk")

            def fits(run: Run) -> bool:
                return measurements.fits(run, seconds - spent())

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
    known, failed = measurements.found, measurements.failed
    return Study(
        folder,
        description,
        measurements.of_generator() + sorted(complete, key=lambda m: m.seconds.value),
        deviation,
        [c.label for c in (*configurations, *first) if c.label not in known and c.label not in failed],
        [f"{label}: {why}" for label, why in failed.items()],
    )

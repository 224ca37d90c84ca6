"""What a cost study would measure, and what it can and cannot answer, without measuring it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mbtf_core.forecast import processor_share
from mbtf_core.run.runner import Runner
from mbtf_core.units import clock, expectation, rounded_duration
from mbtf_gen.forecast import forecast
from mbtf_gen.job import Job
from mbtf_pipeline.cost.answers import FARTHEST
from mbtf_pipeline.cost.measurement import Conditions, MeasurementFolder
from mbtf_pipeline.cost.runs import GENERATOR, LEAST_SECONDS, disk_bytes
from mbtf_pipeline.cost.schedule import Measurements, generator_seconds
from mbtf_pipeline.cost.study import STUDY, no_run, study_config
from mbtf_pipeline.recipe import Recipe

# Paths of the reference and of the generator's rate, which come before runs.
_SETUP_PATHS = 6_000_000
# Studies so many times the least one have time for most comparisons of the generator.
_COMPARISONS = 4.0


@dataclass(frozen=True)
class StudyPlan:
    """What a study would measure.

    Attributes
    ----------
    runs : labels of the runs that its time suffices for and that are not measured yet
    measured : runs that are
    seconds, bytes : that it takes, and on disk
    longest : total seconds of the longest run, measured or not
    least_run : seconds of a study that measures a run; None where any is measured
    least : seconds of a study that forecasts
    generator : whether it compares configurations of the generator
    share : of the processors that other work leaves, as the generator's rate was measured
    overhead : seconds of a run besides generating and training; assumed until a run is measured
    """

    runs: list[str]
    measured: int
    seconds: float
    bytes: int
    longest: float
    least_run: float | None
    least: float
    generator: bool
    share: float
    overhead: float

    def describe(self, asked: float) -> str:
        """Lines: what it measures, and what it can and cannot answer in the time that is asked for."""
        known = f", {self.measured} measured already" if self.measured else ""
        ends = ":" if self.runs else ""
        expected = expectation(self.seconds, self.bytes)
        if not self.runs and self.least_run is not None:
            load = f"with {self.share:.0%} of the processors free"
            return f"complete runs to measure: none; {load}, {no_run(self.least_run, self.least)}"
        lines = [f"{expected}; complete runs to measure: {len(self.runs) or 'none'}{known}{ends}"]
        lines += [f"  {label}" for label in self.runs]
        if self.least_run is not None:
            lines.append(
                f"estimated from a pilot of the generator, while other work leaves {self.share:.0%} of the "
                f"processors, and {self.overhead:.0f} s per run for loading and evaluation; the first run "
                "measures training and the rest, so fewer runs may fit and a forecast may take longer"
            )
        lines.append(f"answers: the error after times of up to about {clock(self.longest)}, measured")
        if asked >= self.least:
            far = clock(FARTHEST * self.longest)
            lines.append(
                f"answers: a forecast for up to {FARTHEST:g} times as long, {far}, with its 95% interval"
            )
        else:
            lines.append(
                f"cannot forecast errors of longer times: that takes --time {rounded_duration(self.least)}"
            )
        if not self.generator:
            lines.append(
                "cannot tell what effects, mesh and number of paths cost: that takes "
                f"--time {rounded_duration(_COMPARISONS * LEAST_SECONDS)}"
            )
        return "\n".join(lines)


def plan_study(recipe: Recipe, folder: Path, *, seconds: float, seed: int | None = None) -> StudyPlan:
    """What :func:`~mbtf_pipeline.cost.study.run_study` would measure, by the rate of the generator that the
    folder has, or that of a pilot on this machine; nothing is written. An InputError where the folder holds
    something else."""
    record = STUDY.read(folder) if STUDY.check(folder) else None
    job = Job.load(study_config(recipe.generate, seed))
    # Alone, as each pilot takes all processors.
    share = processor_share()
    spp, pilot = job.config.queries.spp, forecast(job, seconds=1.0)
    conditions = Conditions.of(job, folder, GENERATOR * seconds)
    found = Measurements(conditions, MeasurementFolder(folder, conditions), Runner(), share=share)
    if not found.recall_rate(spp):
        found.path_seconds = pilot.query_seconds / spp
    setup = 2.0 * pilot.start + _SETUP_PATHS * found.path_seconds
    if record is not None:
        setup = record.get("setup_seconds", setup)
    planned = found.plan_runs(seconds, spp)
    least = found.least_run_seconds(spp, setup), found.least_seconds(spp, setup) or LEAST_SECONDS
    measured = [run for run in planned if found.recall(run)]
    runs, spent = found.fitting(planned, setup + generator_seconds(seconds), seconds)
    times = (run.planned_seconds(found.path_seconds, found.step_seconds) for run in (*measured, *runs))
    longest = max(times, default=0.0) + found.overhead
    labels = [f"{run.label}: {run.queries:,} queries × {spp} paths" for run in runs]
    generator = seconds >= _COMPARISONS * LEAST_SECONDS
    size, share = disk_bytes(runs), found.share
    return StudyPlan(labels, len(measured), spent, size, longest, *least, generator, share, found.overhead)

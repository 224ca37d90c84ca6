"""Forecast of the time of a run on this machine, from start to report, by a pilot of the generator."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from mbtf_core.files.folders import check_space
from mbtf_core.forecast import is_long
from mbtf_core.units import clock, expectation
from mbtf_gen.job import Job, planned_work, query_work, split_queries
from mbtf_pipeline.compare.image_files import scenes
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run import COMPARE_STAGE, data_sets, fit_stage, survey
from mbtf_pipeline.stages import RUN

# Seconds of loading the programs, and of comparison and report besides the paths of their images.
_START, _COMPARE = 2.5, 5.0
# Bytes of a pixel of a reference and of a fit's image.
_REFERENCE_BYTES, _FIT_BYTES = 70, 30
# Seconds of starting and of a path where no pilot was run: those of a slow machine.
_SLOW = (0.0, 2e-6)


@dataclass(frozen=True)
class RunForecast:
    """Expected cost of a run.

    Attributes
    ----------
    start : seconds of loading and compiling
    generating, training, evaluating, comparing : seconds of these; evaluating includes loading
    bytes : on disk
    by_steps : names of the fits that count steps, whose training is not included
    min_steps : fewest steps of a fit, for which training may take longer than its time; 0 where that is known
    """

    start: float
    generating: float
    training: float
    evaluating: float
    comparing: float
    bytes: int
    by_steps: tuple[str, ...]
    min_steps: int

    @property
    def seconds(self) -> float:
        """Of everything."""
        return self.start + self.generating + self.training + self.evaluating + self.comparing

    def describe(self) -> str:
        """One line."""
        text = (
            f"{expectation(self.seconds, self.bytes)} (generate {clock(self.generating)}, "
            f"fit {clock(self.training + self.evaluating)}, compare {clock(self.comparing)})"
        )
        longer = f", or longer for {self.min_steps} steps of training" if self.min_steps else ""
        return text + longer + (f", and the steps of {', '.join(self.by_steps)}" if self.by_steps else "")


class RunForecaster:
    """Forecasts runs of one material; a pilot measures the material and the generator of a recipe."""

    def __init__(self, recipe: Recipe) -> None:
        self.job = Job.load(recipe.generate)

    @cached_property
    def speed(self) -> tuple[float, float]:
        """Seconds of starting the generator, and of a path."""
        from mbtf_gen.forecast import forecast

        found = forecast(self.job, seconds=1.0)
        return found.start, found.query_seconds / query_work(self.job)

    def of(
        self,
        recipe: Recipe,
        stages: Collection[str] | None = None,
        speed: tuple[float, float] | None = None,
    ) -> RunForecast:
        """Forecast of some stages of a recipe of this material, by default of all, at the pilot's speed."""
        from mbtf_fit.training.forecast import closing_seconds, fit_bytes, preparing_seconds
        from mbtf_gen.job import data_bytes

        start, path = self.speed if speed is None else speed
        paths, size, queries = 0.0, 0, 0
        for data in data_sets(recipe):
            job = Job.of(data.config, self.job.material)
            queries = split_queries(job, "train")
            if stages is None or data.stage in stages:
                paths += planned_work(job, job.shards)
                size += data_bytes(job, job.shards)
        fits = {name: fit for name, fit in recipe.fit.items() if stages is None or fit_stage(name) in stages}
        size += sum(fit_bytes(fit, job.lattice) for fit in fits.values())
        comparing, compare = 0.0, recipe.compare
        if stages is None or COMPARE_STAGE in stages:
            pixels = len(list(scenes(compare))) * compare.size**2
            traced = pixels * len(compare.kinds)
            comparing = _COMPARE + traced * compare.spp * path
            size += traced * _REFERENCE_BYTES + pixels * len(recipe.fit) * _FIT_BYTES
        by_time = [fit.training.time for fit in fits.values() if fit.training.steps is None]
        return RunForecast(
            start=_START + (start if paths else 0.0),
            generating=paths * path,
            training=sum(budget.seconds for budget in by_time),
            evaluating=len(fits) * (preparing_seconds(queries) + closing_seconds(queries)),
            comparing=comparing,
            bytes=size,
            by_steps=tuple(name for name, fit in fits.items() if fit.training.steps is not None),
            min_steps=max((budget.min_steps for budget in by_time), default=0),
        )


def forecast_left(recipe: Recipe, folder: Path) -> str | None:
    """Forecast of the stages that a run in a folder has yet to do, in one line. None where they are short and
    small on any machine; an InputError where they do not fit on the disk, or the folder contains something
    else."""
    RUN.check(folder)
    stages = [name for name, reason in survey(recipe, folder).items() if reason]
    forecaster = RunForecaster(recipe)
    expected = forecaster.of(recipe, stages, _SLOW)
    hint = "reduce generate.queries with --set or --quality, or choose another folder with -o"
    check_space(folder, expected.bytes, hint)
    if not is_long(expected.seconds, expected.bytes):
        return None
    return forecaster.of(recipe, stages).describe()

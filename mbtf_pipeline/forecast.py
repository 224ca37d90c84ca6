"""Time and disk space that a recipe takes, from a pilot of the generator on this machine."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from mbtf_core.files.folders import check_folder, check_space
from mbtf_core.forecast import is_long
from mbtf_core.units import clock, expectation
from mbtf_gen.job import Job, planned_paths, split_queries
from mbtf_pipeline.compare.image_files import scenes
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run import COMPARE_STAGE, data_sets, fit_stage, survey
from mbtf_pipeline.run_folder import is_run
from mbtf_pipeline.stages import STAMPS

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
    """

    start: float
    generating: float
    training: float
    evaluating: float
    comparing: float
    bytes: int
    by_steps: tuple[str, ...]

    @property
    def seconds(self) -> float:
        """Of everything."""
        return self.start + self.generating + self.training + self.evaluating + self.comparing

    def describe(self) -> str:
        """One line."""
        fitting = clock(self.training + self.evaluating)
        text = (
            f"{expectation(self.seconds, self.bytes)} (generate {clock(self.generating)}, fit {fitting}, "
            f"compare {clock(self.comparing)})"
        )
        return f"{text}, and the steps of {', '.join(self.by_steps)}" if self.by_steps else text


class RunForecaster:
    """Forecasts runs of one material.

    Parameters
    ----------
    recipe : Recipe
        Its material and generator are measured by the pilot.
    """

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self.material = Job.load(recipe.generate).material

    @cached_property
    def speed(self) -> tuple[float, float]:
        """Seconds of starting the generator, and of a path."""
        from mbtf_gen.forecast import forecast

        job = Job.of(self.recipe.generate, self.material)
        found = forecast(job, seconds=1.0)
        return found.start, found.query_seconds / self.recipe.generate.queries.spp

    def of(
        self, recipe: Recipe, stages: Collection[str] | None = None, speed: tuple[float, float] | None = None
    ) -> RunForecast:
        """Forecast of a recipe of this material.

        Parameters
        ----------
        recipe : Recipe
        stages : names of the stages that will run; all by default
        speed : as :attr:`speed`, which is measured by default
        """
        from mbtf_fit.training.forecast import evaluation_seconds, fit_bytes
        from mbtf_gen.job import data_bytes

        start, path = self.speed if speed is None else speed
        paths = size = queries = 0
        for data in data_sets(recipe):
            job = Job.of(data.config, self.material)
            queries = split_queries(job, "train")
            if stages is None or data.stage in stages:
                paths += planned_paths(job, job.shards)
                size += data_bytes(job, job.shards)
        fits = {name: fit for name, fit in recipe.fit.items() if stages is None or fit_stage(name) in stages}
        size += sum(fit_bytes(fit, job.lattice) for fit in fits.values())
        comparing = 0.0
        compare = recipe.compare
        if stages is None or COMPARE_STAGE in stages:
            pixels = len(list(scenes(compare))) * compare.size**2
            traced = pixels * len(compare.kinds)
            comparing = _COMPARE + traced * compare.spp * path
            size += traced * _REFERENCE_BYTES + pixels * len(recipe.fit) * _FIT_BYTES
        timed = [fit.training.time for fit in fits.values() if fit.training.steps is None]
        return RunForecast(
            start=_START + (start if paths else 0.0),
            generating=paths * path,
            training=sum(timed),
            evaluating=len(fits) * evaluation_seconds(queries),
            comparing=comparing,
            bytes=size,
            by_steps=tuple(name for name, fit in fits.items() if fit.training.steps is not None),
        )


def forecast_left(recipe: Recipe, folder: Path) -> RunForecast | None:
    """Forecast of the stages that a run in a folder has yet to do; None where they are short and small on any
    machine.

    Raises
    ------
    InputError : they do not fit on the disk, or the folder contains something else
    """
    check_folder(folder, is_run, "run")
    stages = None
    if (folder / STAMPS).exists():
        stages = [name for name, decision in survey(recipe, folder).items() if decision.runs]
    forecaster = RunForecaster(recipe)
    expected = forecaster.of(recipe, stages, _SLOW)
    hint = "reduce generate.queries with --set or --quality, or choose another folder with -o"
    check_space(folder, expected.bytes, hint)
    return forecaster.of(recipe, stages) if is_long(expected.seconds, expected.bytes) else None

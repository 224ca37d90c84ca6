"""Time of a run: its forecast, and a run that fits into a total time.

A pilot of the generator forecasts the time of a recipe on this machine, from start to report. A total time
takes the best quality preset that fits, and training gets the rest; a time too short for any preset shortens
the training of a draft. Once the data are generated, training gets the time that is then left, but no less
than that of the preset: a run that thus takes longer than its time says so.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

from mbtf_core.app.options import Quality
from mbtf_core.errors import InputError, UsageError
from mbtf_core.files.atomic import data_sha256, read_json, write_json
from mbtf_core.files.folders import check_space, free_space, owned
from mbtf_core.forecast import is_long
from mbtf_core.units import clock, expectation
from mbtf_gen.job import Job, planned_work, query_work, split_queries
from mbtf_pipeline.compare.image_files import scenes
from mbtf_pipeline.recipe import Recipe, preset_recipe, with_training
from mbtf_pipeline.run import COMPARE_STAGE, data_sets, fit_stage, layout_of, survey
from mbtf_pipeline.stages import RUN, write_run_record

# Seconds of loading the programs, and of comparison and report besides the paths of their images.
_START, _COMPARE = 2.5, 5.0
# Bytes of a pixel of a reference and of a fit's image.
_REFERENCE_BYTES, _FIT_BYTES = 70, 30
# Seconds of starting, of a path and of a training step where no pilot was run: those of a slow machine.
_SLOW, _SLOW_STEP = (0.0, 2e-6), 0.1

SPLIT_NAME = "time_split.json"
SPLIT_SCHEMA = 6
# Presets that a time chooses from; `paper` needs a GPU.
PRESETS: tuple[Quality, ...] = ("draft", "standard", "high")
# Share of the time that is left for what the forecast does not know.
_RESERVE = 0.04


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


def forecast_left(recipe: Recipe, folder: Path, draft: Callable[[], Recipe]) -> str | None:
    """Forecast of the stages that a run in a folder has yet to do, as a line with faster options: `draft`
    makes the recipe of that preset. None where they are short and small on any machine; an InputError where
    they do not fit on the disk, or the folder contains something else."""
    RUN.check(folder)
    stages = [name for name, reason in survey(recipe, folder).items() if reason]
    forecaster = RunForecaster(recipe)
    expected = forecaster.of(recipe, stages, _SLOW)
    hint = "reduce generate.queries with --set or --quality, or choose another folder with -o"
    check_space(folder, expected.bytes, hint)
    if not is_long(expected.seconds, expected.bytes):
        return None
    shorter = draft()
    expected, other = forecaster.of(recipe, stages), forecaster.of(shorter)
    training = max(other.training, other.min_steps * _SLOW_STEP * len(shorter.fit))
    faster = ["--quality draft"] * (other.seconds - other.training + training < expected.seconds)
    faster += ["--time 2min"] * (expected.seconds > 120.0)
    return expected.describe() + (f"; faster: {', or '.join(faster)}" if faster else "")


@dataclass(frozen=True)
class Split:
    """How a total time is spent.

    Attributes
    ----------
    quality : the preset
    training, least : seconds of training each fit, as planned and at least
    after : seconds of loading, evaluation, comparison and report
    final : whether the training time counts how long generating took
    """

    quality: Quality
    training: float
    least: float
    after: float
    final: bool = False


class TimedRun:
    """A recipe that is to end within a total time.

    Parameters
    ----------
    file, assignments : recipe and ``a.b=c``, which override presets
    folder : of the run; it stores the split, so that the same command resumes with the same one
    progress : receives lines: the split, and by how much the run will be late
    quality : the preset to use; by default the best that fits
    began : start of the run by ``time.perf_counter``; now by default

    Raises
    ------
    UsageError : the time is too short, or a model's data layout cannot be timed
    InputError : recipe, material or folder cannot be used
    """

    def __init__(
        self,
        file: Path,
        seconds: float,
        folder: Path,
        command: str,
        progress: Callable[[str], None],
        quality: Quality | None = None,
        assignments: Sequence[str] = (),
        began: float | None = None,
        dry_run: bool = False,
    ) -> None:
        self._progress = progress
        self._began = time.perf_counter() if began is None else began
        self._seconds, self._file, self._assignments = seconds, file, assignments
        names = PRESETS if quality is None else (quality,)
        recipes = {name: preset_recipe(file, name, assignments) for name in names}
        first = recipes[names[0]]
        if any(layout_of(fit, "shuffled") != "shuffled" for fit in first.fit.values()):
            problem = "only models of the shuffled layout can share a time"
            raise UsageError(problem, where="--time", hint="leave out the fits of models with another layout")
        options = [
            r.model_dump(mode="json", include={"generate", "fit", "compare"}) for r in recipes.values()
        ]
        self._key = data_sha256({"schema": SPLIT_SCHEMA, "time": seconds, "recipes": options})
        self._path = folder / SPLIT_NAME
        if dry_run:
            RUN.check(folder)
            self.split = self._stored() or self._plan(recipes)
            return
        with owned(folder):
            RUN.check(folder)
            split = self._stored()
            if split is None:
                split = self._plan(recipes)
                write_run_record(folder, first, command)
            self._store(split)

    @property
    def recipe(self) -> Recipe:
        """The recipe with the split's preset and training time."""
        split = self.split
        recipe = preset_recipe(self._file, split.quality, self._assignments, split.training)
        return with_training(recipe, time=split.training, steps=None)

    def generated(self, recipe: Recipe) -> Recipe:
        """The recipe with the training time that is left now that the data are generated."""
        if not self.split.final:
            left = self._left() - self.split.after
            each = max(self.split.least, round(left / len(recipe.fit), 1))
            late = each * len(recipe.fit) - left
            if late > 1.0:
                self._progress(f"time: generating took long; the run will be about {clock(late)} late")
            self._store(replace(self.split, training=each, final=True))
        return with_training(recipe, time=self.split.training, steps=None)

    def _left(self) -> float:
        return (1.0 - _RESERVE) * self._seconds - (time.perf_counter() - self._began)

    def _stored(self) -> Split | None:
        try:
            data = read_json(self._path)
            return Split(**data["split"]) if data["key"] == self._key else None
        except (InputError, KeyError, TypeError):
            return None

    def _store(self, split: Split) -> None:
        self.split = split
        write_json(self._path, {"key": self._key, "split": asdict(split)})

    def _plan(self, recipes: Mapping[Quality, Recipe]) -> Split:
        """The best preset that fits; the first one with less training if none does."""
        forecaster = RunForecaster(next(iter(recipes.values())))
        forecasts = {name: forecaster.of(recipe) for name, recipe in recipes.items()}
        left, free = self._left(), free_space(self._path.parent)
        fitting = [name for name, f in forecasts.items() if f.seconds <= left and f.bytes <= free]
        quality = fitting[-1] if fitting else next(iter(recipes))
        expected, fits = forecasts[quality], len(recipes[quality].fit)
        hint = "choose another folder with -o, or a lower resolution: --set generate.queries.resolution=64"
        check_space(self._path.parent, expected.bytes, hint)
        rest, after = expected.seconds - expected.training, expected.evaluating + expected.comparing
        each = round((left - rest) / fits, 1)
        if each < 1.0:
            problem = f"is too short: all but training takes about {clock(rest)}"
            raise UsageError(problem, where="--time", hint="give more, or reduce generate.queries with --set")
        self._progress(
            f"time: preset {quality}, {clock(expected.generating)} of generating, {clock(each)} of training "
            f"each fit, {clock(after)} of evaluation, comparison and report"
        )
        # `paper` counts steps; its training, and that of a shortened draft, may lose half.
        least = expected.training / fits
        return Split(quality, each, least if 0 < least <= each else 0.5 * each, round(after, 1))


def round_down(count: float) -> int:
    """A number of queries with two significant digits."""
    digits = 10 ** max(0, len(str(int(count))) - 2)
    return max(1, int(count / digits) * digits)

"""Fits a whole run into a total time: the best quality preset that fits, with more data and longer training.

A pilot of the generator forecasts the time of each preset on this machine, from start to report. The best
one that fits is scaled: s times as many queries and s times the training, so that generating keeps its share.
With n queries, f fits, and the seconds g of generating a query and b of loading and evaluating it,

    T = fixed + n g + f n b + training.

Disk space, memory and the queries per texel of the largest preset limit n; training gets what is left. Once
the data are generated, training gets the time that is then left, but no less than that of the preset: a run
that thus takes longer than its time says so. A time too short for any preset gets a reduced draft.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from mbtf_core.app.options import Quality
from mbtf_core.config.settings import deep_merge
from mbtf_core.data.shard_files import row_bytes
from mbtf_core.errors import InputError, UsageError
from mbtf_core.files.atomic import data_sha256, read_json, write_json
from mbtf_core.files.folders import check_space, owned
from mbtf_core.units import clock, format_duration
from mbtf_fit.config import FitConfig
from mbtf_gen.config.generator import count_queries
from mbtf_gen.config.presets import GENERATOR
from mbtf_gen.job import Job, split_queries
from mbtf_pipeline.forecast import RunForecaster
from mbtf_pipeline.presets import preset_recipe
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run import layout_of
from mbtf_pipeline.run_folder import RUN, write_run_record

SPLIT_NAME = "time_split.json"
SPLIT_SCHEMA = 5
# Presets that a time chooses from; `paper` needs a GPU.
PRESETS: tuple[Quality, ...] = ("draft", "standard", "high")
# The shortest total time, seconds: start-up takes most of a shorter one.
SHORTEST = 60.0
# Share of the time that is left for what the forecast does not know.
_RESERVE = 0.04
_FEWEST_QUERIES = 4096
# Share of the free disk space that training queries may take.
_DISK = 0.25


@dataclass(frozen=True)
class Split:
    """How a total time is spent.

    Attributes
    ----------
    quality : the preset; queries : of training, `scale` times those of the preset
    training_each, least_each : seconds of training each fit, as planned and at least
    generating : seconds of generating
    after : seconds of loading, evaluation, comparison and report
    final : whether the training time counts how long generating took
    """

    quality: Quality
    queries: int
    scale: float
    training_each: float
    least_each: float
    generating: float
    after: float
    final: bool = False

    def describe(self) -> str:
        """One line."""
        return (
            f"time: preset {self.quality} with {self.queries} queries ({self.scale:.2g} times the preset's), "
            f"{clock(self.generating)} of generating, {clock(self.training_each)} of training each fit, "
            f"{clock(self.after)} of evaluation, comparison and report"
        )


class TimedRun:
    """A recipe that is to end within a total time.

    Parameters
    ----------
    file, assignments : recipe and ``a.b=c``, which override presets
    seconds : total time
    folder : of the run; it stores the split, so that the same command resumes with the same one
    quality : the preset to use; by default the best that fits
    progress : receives lines: the split, and by how much the run will be late
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
        folder: Path | None,
        command: str,
        progress: Callable[[str], None],
        *,
        quality: Quality | None = None,
        assignments: Sequence[str] = (),
        began: float | None = None,
    ) -> None:
        self._progress = progress
        self._began = time.perf_counter() if began is None else began
        self._seconds, self._file, self._assignments = seconds, file, assignments
        if seconds < SHORTEST:
            problem = f"{format_duration(seconds)} is too short: starting up takes most of it"
            raise UsageError(problem, where="--time", hint=f"give {format_duration(SHORTEST)} or more")
        names = PRESETS if quality is None else (quality,)
        recipes = {name: preset_recipe(file, name, assignments) for name in names}
        first = recipes[names[0]]
        if any(layout_of(fit) != "shuffled" for fit in first.fit.values()):
            problem = "only models of the shuffled layout can share a time"
            raise UsageError(problem, where="--time", hint="leave out the fits of models with another layout")
        self.folder = first.folder if folder is None else folder
        options = [
            r.model_dump(mode="json", include={"generate", "fit", "compare"}) for r in recipes.values()
        ]
        self._key = data_sha256({"schema": SPLIT_SCHEMA, "time": seconds, "recipes": options})
        with owned(self.folder):
            RUN.check(self.folder)
            split = self._stored()
            if split is None:
                split = self._plan(recipes)
                write_run_record(self.folder, first, command)
            self._store(split)
        progress(split.describe())

    @property
    def recipe(self) -> Recipe:
        """The recipe with the split's queries, network and training time."""
        split = self.split
        recipe = preset_recipe(self._file, split.quality, self._assignments, split.training_each)
        queries = recipe.generate.queries.model_copy(update={"train": str(split.queries)})
        fits = {name: _with_time(fit, split.training_each) for name, fit in recipe.fit.items()}
        generate = recipe.generate.model_copy(update={"queries": queries})
        return recipe.model_copy(update={"generate": generate, "fit": fits})

    def generated(self, recipe: Recipe) -> Recipe:
        """The recipe with the training time that is left now that the data are generated."""
        if not self.split.final:
            left = self._left() - self.split.after
            each = max(self.split.least_each, round(left / len(recipe.fit), 1))
            late = each * len(recipe.fit) - left
            if late > 1.0:
                self._progress(f"time: generating took long; the run will be about {clock(late)} late")
            self._store(replace(self.split, training_each=each, final=True))
        fits = {name: _with_time(fit, self.split.training_each) for name, fit in recipe.fit.items()}
        return recipe.model_copy(update={"fit": fits})

    def _left(self) -> float:
        return (1.0 - _RESERVE) * self._seconds - (time.perf_counter() - self._began)

    def _stored(self) -> Split | None:
        try:
            data = read_json(self.folder / SPLIT_NAME)
            return Split(**data["split"]) if data["key"] == self._key else None
        except (InputError, KeyError, TypeError):
            return None

    def _store(self, split: Split) -> None:
        self.split = split
        write_json(self.folder / SPLIT_NAME, {"key": self._key, "split": asdict(split)})

    def _plan(self, recipes: dict[Quality, Recipe]) -> Split:
        """The split of the best preset that fits; of the first one, reduced, if none does."""
        forecaster = RunForecaster(next(iter(recipes.values())))
        free = shutil.disk_usage(self.folder).free
        found = [self._scaled(name, recipe, forecaster) for name, recipe in recipes.items()]
        fitting = [one for one in found if one[0].scale >= 1.0 and one[1] <= free]
        split, size = (fitting or found[:1])[-1]
        hint = "choose another folder with -o, or a lower resolution: --set generate.queries.resolution=64"
        check_space(self.folder, size, hint)
        return split

    def _scaled(self, quality: Quality, recipe: Recipe, forecaster: RunForecaster) -> tuple[Split, int]:
        """A preset scaled to the time, and its bytes."""
        from mbtf_fit.training.forecast import evaluation_seconds

        whole, fits = forecaster.of(recipe), len(recipe.fit)
        start, path = forecaster.speed
        job = Job.of(recipe.generate, forecaster.material)
        own = split_queries(job, "train")
        evaluating = fits * (evaluation_seconds(1) - evaluation_seconds(0))
        query = recipe.generate.queries.spp * path + evaluating
        fixed = whole.seconds - own * query - whole.training
        left = self._left() - fixed
        # `paper` counts steps; its training takes what is left.
        scale = left / (own * query + whole.training)
        most = max(own, _most_queries(self.folder, recipe, job.lattice.texels()))
        queries = round_down(max(_FEWEST_QUERIES, min(scale * own, most)))
        if scale >= 1.0:
            queries, scale = max(queries, own), max(queries, own) / own
        more = queries - own
        each = max(1.0, (left - queries * query) / fits)
        split = Split(
            quality=quality,
            queries=queries,
            scale=scale,
            training_each=round(each, 1),
            # A reduced draft gets half of its training at least.
            least_each=whole.training / fits if scale >= 1.0 and whole.training else 0.5 * each,
            generating=round(start + whole.generating + more * recipe.generate.queries.spp * path, 1),
            after=round(whole.evaluating + whole.comparing + more * evaluating, 1),
        )
        return split, whole.bytes + more * row_bytes(holes=True)


def _most_queries(folder: Path, recipe: Recipe, texels: int) -> float:
    """Training queries to which a preset is scaled at most."""
    memory = min(fit.data.memory for fit in recipe.fit.values())
    space = min(_DISK * shutil.disk_usage(folder).free, memory)
    return min(space / row_bytes(holes=True), count_queries(GENERATOR["high"]["queries.train"], texels))


def round_down(count: float) -> int:
    """A number of queries with two significant digits."""
    digits = 10 ** max(0, len(str(int(count))) - 2)
    return max(1, int(count / digits) * digits)


def _with_time(fit: FitConfig, seconds: float) -> FitConfig:
    data = deep_merge(fit.model_dump(), {"training": {"time": seconds, "steps": None}})
    return FitConfig.model_validate(data)

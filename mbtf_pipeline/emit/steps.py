"""The steps of a recipe as commands of the programs, with their order and resources.

The data set is an array of commands ``mbtf-gen --slice i/n``, then ``mbtf-gen merge``; each fit is a command
``mbtf-fit``. The last command is ``mbtf-pipeline run``: it finds all of that finished in the run's folder,
and makes comparison and report. A command that is interrupted or repeated resumes.
"""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mbtf_gen.job import Job
from mbtf_pipeline.forecast import RunForecast
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run import DataSet, data_sets, layout_of
from mbtf_pipeline.run_folder import FITS

# Sub-folder of the job files that holds the configurations, and the recipe in it.
CONFIGS, RECIPE_CONFIG = "config", "recipe.yaml"
# The limit of a job is a multiple of its forecast, in whole units; without a forecast it is this.
_LIMIT_FACTOR, _LIMIT_UNIT, _SHORTEST_LIMIT, _UNKNOWN_LIMIT = 4.0, 600.0, 1800.0, 4 * 3600.0
# Jobs that only read records.
_LIGHT_MEMORY = 2e9


@dataclass(frozen=True)
class Request:
    """Resources of the jobs of a run.

    Attributes
    ----------
    cpus : int
        Processor cores of each job.
    memory : float
        Bytes of each job.
    seconds : float or None
        Time limit of each job; None: from the forecast.
    gpus : int
        GPUs of each fit.
    """

    cpus: int = 8
    memory: float = 8e9
    seconds: float | None = None
    gpus: int = 0


@dataclass(frozen=True)
class Resources:
    """Resources of one job: cores, bytes, seconds at most, GPUs."""

    cpus: int
    memory: float
    seconds: float
    gpus: int = 0

    @property
    def mebibytes(self) -> int:
        """Memory in MiB, rounded up."""
        return math.ceil(self.memory / 2**20)


@dataclass(frozen=True)
class Step:
    """One command, or an array of commands that differ in their slice.

    Attributes
    ----------
    name : str
        Unique, and usable as a file name: ``generate``, ``fit-relief``.
    title : str
        What it makes, in a few words.
    words : tuple of str
        The command.
    needs : tuple of str
        Names of the steps that must end before.
    resources : Resources
        Of each command.
    slices : int
        Number of commands of an array; 0 for a single command.
    is_fit : bool
        Whether it is a fit.
    timed : bool
        Whether it trains for a time, so that others on the same processors would change the result.
    """

    name: str
    title: str
    words: tuple[str, ...]
    needs: tuple[str, ...]
    resources: Resources
    slices: int = 0
    is_fit: bool = False
    timed: bool = False

    def command(self, index: str = "") -> str:
        """The command line for a shell.

        Parameters
        ----------
        index : str
            Shell expression of the slice's number, from 1.

        Returns
        -------
        str
        """
        line = shlex.join(self.words)
        return f'{line} --slice "{index}/{self.slices}"' if self.slices else line


def from_here(path: Path) -> str:
    """A path as the commands name it: relative to the current folder, if it lies in it."""
    relative = os.path.relpath(path)
    outside = relative.split(os.sep)[0] == os.pardir
    return os.path.abspath(path) if outside else relative


def config_of(step: str) -> str:
    """File name of a step's configuration."""
    return f"{step}.yaml"


def generate_step(data: DataSet) -> str:
    """Name of the step that renders a data set."""
    return data.stage.replace(" ", "-")


def merge_step(data: DataSet) -> str:
    """Name of the step that completes a data set."""
    return generate_step(data).replace("generate", "merge", 1)


def fit_step(name: str) -> str:
    """Name of a fit's step."""
    return f"fit-{name}"


def steps_of(
    recipe: Recipe, run: Path, folder: Path, slices: int, request: Request, expected: RunForecast | None
) -> list[Step]:
    """The steps of a recipe, each after those that it needs.

    Parameters
    ----------
    recipe : Recipe
    run : Path
        Folder of the run.
    folder : Path
        Folder of the job files, which holds the configurations.
    slices : int
        Slices of each data set; as many as it has shards at most.
    request : Request
    expected : RunForecast or None
        Decides time limits; may be None where the request has one.

    Returns
    -------
    list of Step
    """
    configs = Path(from_here(folder)) / CONFIGS
    place = Path(from_here(run))
    limits = _Limits(recipe, request, expected)
    out: list[Step] = []
    merged: dict[str, str] = {}
    shards_of: dict[str, str] = {}
    words: tuple[str, ...]
    for data in data_sets(recipe):
        shards, name = place / data.sub, generate_step(data)
        words = ("mbtf-gen", "--config", str(configs / config_of(name)), "-o", str(shards))
        count = min(slices, len(Job.load(data.config).shards))
        out.append(Step(name, f"data set {shards}", words, (), limits.generate(count), count))
        words = ("mbtf-gen", "merge", str(shards))
        out.append(Step(merge_step(data), f"manifest of {shards}", words, (name,), limits.light()))
        merged[data.config.queries.layout] = merge_step(data)
        shards_of[data.config.queries.layout] = str(shards)
    for fit, config in recipe.fit.items():
        layout, name, material = layout_of(config), fit_step(fit), place / FITS / fit
        config_file = str(configs / config_of(name))
        words = ("mbtf-fit", shards_of[layout], "--config", config_file, "-o", str(material))
        timed = config.training.steps is None
        needs: tuple[str, ...] = (merged[layout],)
        limit = limits.fit(fit)
        out.append(Step(name, f"material {material}", words, needs, limit, is_fit=True, timed=timed))
    words = ("mbtf-pipeline", "run", str(configs / RECIPE_CONFIG), "-o", str(place))
    needs = (*merged.values(), *map(fit_step, recipe.fit))
    out.append(Step("report", f"comparison and report of {place}", words, needs, limits.report()))
    return out


class _Limits:
    """Resources of the steps, with limits well above the forecast."""

    def __init__(self, recipe: Recipe, request: Request, expected: RunForecast | None) -> None:
        self._recipe, self._request, self._expected = recipe, request, expected
        # The forecast is that of this machine.
        self._slower = max(1.0, (os.cpu_count() or 1) / request.cpus)

    def generate(self, slices: int) -> Resources:
        e = self._expected
        return self._of(None if e is None else e.start + self._slower * e.generating / slices)

    def light(self) -> Resources:
        request = self._request
        limit = _SHORTEST_LIMIT if request.seconds is None else request.seconds
        return Resources(1, min(request.memory, _LIGHT_MEMORY), limit)

    def fit(self, name: str) -> Resources:
        training, e = self._recipe.fit[name].training, self._expected
        known = training.steps is None and e is not None
        seconds = training.time + e.evaluating / len(self._recipe.fit) if known and e is not None else None
        return self._of(seconds, self._request.gpus)

    def report(self) -> Resources:
        e = self._expected
        return self._of(None if e is None else e.start + self._slower * (e.comparing + e.evaluating))

    def _of(self, seconds: float | None, gpus: int = 0) -> Resources:
        request = self._request
        return Resources(request.cpus, request.memory, _limit(request.seconds, seconds), gpus)


def _limit(asked: float | None, expected: float | None) -> float:
    if asked is not None:
        return asked
    if expected is None:
        return _UNKNOWN_LIMIT
    return max(_SHORTEST_LIMIT, _LIMIT_UNIT * math.ceil(_LIMIT_FACTOR * expected / _LIMIT_UNIT))


def waves(steps: Sequence[Step]) -> list[list[Step]]:
    """The steps in groups: each needs steps of earlier groups only.

    Parameters
    ----------
    steps : sequence of Step
        Each after those that it needs.

    Returns
    -------
    list of list of Step
    """
    level: dict[str, int] = {}
    for step in steps:
        level[step.name] = max((level[name] + 1 for name in step.needs), default=0)
    return [[s for s in steps if level[s.name] == at] for at in range(max(level.values()) + 1)]

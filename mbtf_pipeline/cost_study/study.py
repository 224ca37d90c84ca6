"""A cost study: measures what accuracy costs, within a time budget, and goes on where it stopped."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mbtf_core.atomic import read_json, write_json, write_text
from mbtf_core.config_file import dump_yaml
from mbtf_core.errors import InputError
from mbtf_core.folders import ELSEWHERE, check_folder, make_folder
from mbtf_core.stats import Estimate, signal_variance
from mbtf_gen.config.generator import GeneratorConfig, count_queries
from mbtf_gen.material.material import load_material
from mbtf_pipeline.cost_study.fit_runs import GENERATOR, chains
from mbtf_pipeline.cost_study.generator_benchmark import GeneratorBenchmark
from mbtf_pipeline.cost_study.generator_runs import GeneratorTask, generator_tasks
from mbtf_pipeline.cost_study.measurements import Point, PointFolder
from mbtf_pipeline.cost_study.repeats import repeat_chains
from mbtf_pipeline.cost_study.runs import Chain, RunRequest, RunRunner
from mbtf_pipeline.cost_study.seed_variance import Scatter, seed_scatter, with_scatter
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run_folder import locked, machine

STUDY_NAME = "study.json"
STUDY_FORMAT = "mbtf-cost"
STUDY_SCHEMA = 1
CONFIG_NAME = "generate.yaml"
WORK = ".work"
# Budget of a new study, seconds.
NEW_BUDGET = 600.0
# Share of the budget that is kept for whole chains while the generator is studied.
_RESERVED = 0.7
# Seconds of tracing in the data set that tells what a query costs on disk.
_TRIAL = 3.0
# Deviation of values, relative to their mean, below which a fit has nothing to learn.
_LEAST_VARIATION = 0.005
# Settings that the generator's share of the budget is divided among.
_SETTINGS = 42

Tell = Callable[[float, str], None]


@dataclass
class Study:
    """What a study has measured.

    Attributes
    ----------
    folder : of the study
    description : name, command, budget, seed, machine, and when it was made
    points : in the order of measurement
    skipped : names of settings for which no time was left
    scatter : of chains over seeds, which their bars hold; None where it is not known
    failed : chains that could not be measured, and why
    test_seconds : what the recipe's test split takes, which commands of chains make besides; None where no
        price of paths is known
    """

    folder: Path
    description: dict[str, Any]
    points: list[Point] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    scatter: Scatter | None = None
    failed: list[str] = field(default_factory=list)
    test_seconds: float | None = None


def claim(folder: Path) -> None:
    """Make a study's folder, or take an empty one or one that holds a study of this kind of machine: seconds
    of another one would stand beside its own.

    Raises
    ------
    InputError : it holds something else
    """
    check_folder(folder, lambda path: bool(_record(path)), "cost study")
    make_folder(folder)
    if record := _record(folder):
        there, here = record.get("machine", {}).get("system"), machine()["system"]
        if there != here:
            raise InputError(
                f"holds a cost study made on another kind of machine ({there}; this is {here})",
                where=folder,
                hint=ELSEWHERE,
            )


def _record(folder: Path) -> dict[str, Any]:
    """What a folder says of the study that it holds; empty where it holds none."""
    try:
        found = read_json(folder / STUDY_NAME)
    except InputError:
        return {}
    return found if found.get("format") == STUDY_FORMAT else {}


def budget_of(folder: Path) -> float:
    """Seconds of the study in a folder; those of a new one where there is none."""
    budget = _record(folder).get("budget")
    return float(budget) if isinstance(budget, int | float) and budget > 0 else NEW_BUDGET


def _check_variation(bench: GeneratorBenchmark) -> None:
    """Whether there is anything to learn of a material.

    Raises
    ------
    InputError : it reflects nothing, or the same everywhere and in all directions
    """
    reference, mean = bench.reference({}, 0), bench.mean({}).value
    if not mean > 0:
        raise InputError(
            "reflects nothing: every value is 0",
            where=bench.config.material,
            hint="study a material with a base color or gloss",
        )
    variance = signal_variance(reference.a, reference.b)
    if variance.value + 2 * variance.error < (_LEAST_VARIATION * mean) ** 2:
        raise InputError(
            "reflects the same everywhere and in all directions: there is nothing to fit",
            where=bench.config.material,
            hint="study a material with a relief or textures",
        )


def studied(config: GeneratorConfig, seed: int | None) -> GeneratorConfig:
    """A recipe's generator as its study takes it: with numbers of paths, which a target error would override,
    and queries one by one, which all models but one learn from."""
    queries = config.queries.model_copy(update={"target_error": None, "layout": "shuffled"})
    seeds = {} if seed is None else {"seed": seed}
    return config.model_copy(update={"queries": queries, **seeds})


def run_study(
    recipe: Recipe,
    folder: Path,
    *,
    budget: float,
    narrow: float = 0.0,
    seed: int | None = None,
    command: str = "",
    tell: Tell | None = None,
) -> Study:
    """Measure what the budget allows; points that were measured before are kept.

    Parameters
    ----------
    recipe : its material and generator are studied; fits and comparison are not used
    budget : seconds for everything, points that are done already counted as free
    narrow : further seconds, for chains of other seeds where bars are wide
    seed : of queries, paths and first weights; the recipe's by default
    tell : called with (share of the budget spent, note)

    Raises
    ------
    InputError : the material or the folder cannot be used
    PartialError : another process is at work in the folder, or the disk is full; the same command goes on
    """
    begin = time.perf_counter()
    config = studied(recipe.generate, seed)
    material = load_material(Path(config.material), config.geometry.make_tileable)
    claim(folder)

    def note(text: str) -> None:
        if tell is not None:
            tell(min(1.0, (time.perf_counter() - begin) / (budget + narrow)), text)

    def left() -> float:
        return budget - (time.perf_counter() - begin)

    with locked(folder, STUDY_NAME):
        description = {
            "format": STUDY_FORMAT,
            "schema": STUDY_SCHEMA,
            "name": recipe.name,
            "command": command,
            "budget": budget,
            "seed": config.seed,
            "material": config.material,
            "queries": config.queries.model_dump(mode="json"),
            "made": time.strftime("%Y-%m-%d"),
            "machine": machine(),
        }
        bench = GeneratorBenchmark(config, material, config.seed)
        note("reference")
        # Before anything of the study that may be there is written over.
        _check_variation(bench)
        write_json(folder / STUDY_NAME, description)
        data = config.model_dump(mode="json")
        write_text(folder / CONFIG_NAME, dump_yaml(data))
        study = Study(folder, description)
        store = PointFolder(folder, {"config": config.hash(material.digests)})
        generator = f"mbtf-gen {config.material} --config {folder / CONFIG_NAME}"
        each = 0.5 * GENERATOR * budget / _SETTINGS
        for task in generator_tasks(bench):
            point = store.get(task.study, task.key)
            if point is None and left() > _RESERVED * budget:
                note(task.label)
                point = task.run(bench, each)
                store.put(task.key, point)
            _keep(study, point, task, task.command(generator))
        price = _price(study.points)
        if price is not None:
            texels = bench.job({}).lattice.texels()
            tests = count_queries(config.queries.test, texels)
            study.test_seconds = tests * price(config.queries.test_spp)
            work = RunRunner(config, folder / WORK, generator, note)
            extra = _beyond_tracing(store, work, price)
            _measure_chains(study, store, work, budget, narrow, lambda n: price(n) + extra, left)
        if narrow > 0 and study.scatter is None:
            study.skipped.append("other seeds: how far chains scatter is not known yet")
    return study


def _keep(study: Study, point: Point | None, task: GeneratorTask | Chain, command: str) -> None:
    """Take a point up; its command names the study's folder, which may have moved since it was measured."""
    if point is None:
        study.skipped.append(task.label)
    else:
        study.points.append(replace(point, series=task.series, name=task.name, command=command))


def _price(points: Iterable[Point]) -> Callable[[int], float] | None:
    """Seconds per query by its paths, from those that were measured: the nearest number of paths, in
    proportion."""
    known = {int(p.setting["queries.spp"]): p.seconds.value * 1e-6 for p in points if p.study == "paths"}
    if not known:
        return None

    def price(paths: int) -> float:
        nearest = min(known, key=lambda n: abs(n - paths))
        return known[nearest] * (paths / nearest if nearest != paths else 1.0)

    return price


def _beyond_tracing(store: PointFolder, work: RunRunner, price: Callable[[int], float]) -> float:
    """Seconds of a query beyond tracing: to draw, group and write it. From two data sets, the smaller of
    which takes what starting takes; stored as a point, so that a study that goes on has the same chains."""
    spp = work.config.queries.spp
    count = max(1, int(_TRIAL / price(spp)))
    key = {"queries": count, "spp": spp}
    point = store.get("price", key)
    if point is None:
        seconds = []
        for queries in (1, count):
            data = RunRequest(queries, spp)
            seconds.append(work.data(data).seconds)
            work.forget(data)
        nothing = Estimate(math.nan, math.inf, 0)
        taken = Estimate((seconds[1] - seconds[0]) / count * 1e6, 0.0, 1)
        point = Point("price", "written", f"{count} queries", key, "", taken, nothing)
        store.put(key, point)
    return max(0.0, point.seconds.value * 1e-6 - price(spp))


def _measure_chains(
    study: Study,
    store: PointFolder,
    work: RunRunner,
    budget: float,
    narrow: float,
    price: Callable[[int], float],
    left: Callable[[], float],
) -> None:
    """Measure chains, then again those whose bars are too wide; bars get the scatter of seeds."""
    # Prices are those of stored points: a study that goes on has the same tasks.
    tasks = list(chains(budget, work.config.queries.spp, price))
    needed = [t.data for t in tasks]
    measured: dict[int, Chain] = {}
    failed: list[dict[str, Any]] = []
    try:
        for number, task in enumerate(tasks):
            point = store.get(task.study, task.key)
            try:
                if point is None and left() > task.seconds(price, data=not work.has(task.data)):
                    point = work.measure(task)
                    store.put(task.key, point)
            except InputError as error:
                # What was measured, and what is still to come, is worth a page all the same.
                study.failed.append(f"{task.label}: {error.what}")
                failed.append(task.key)
            else:
                _keep(study, point, task, work.command_of(task))
                if point is not None and task.study != "seeds":
                    measured[len(study.points) - 1] = task
            if task.data not in needed[number + 1 :]:
                work.forget(task.data)
        end = time.perf_counter() + narrow

        def enough(chain: Chain, data: bool) -> bool:
            return end - time.perf_counter() > chain.seconds(price, data=data)

        study.scatter = seed_scatter(study.points)
        if study.scatter is not None:
            repeats = repeat_chains(study.points, measured, study.scatter, store, work, enough, failed)
            study.failed += repeats.failed
            study.points = with_scatter(study.points, study.scatter, repeats.again)
    finally:
        work.clear()

"""A total time for generating and training, split so that little error is left: pilot chains on this very
material and machine, then one allocation.

Three short chains each generate for another share of their time and train for the rest; the share of the
least error, by a parabola through the three, is taken for what is left of the budget. Error changes slowly
about its least value, so a rough share is enough. The pilots also tell what fits take besides training:
loading, calibrating, judging. Budgets too short for pilots take a fixed share, and no account of that. Where
queries cost next to nothing, disk and memory bound their number, and training gets the time.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mbtf_core.atomic import read_json, write_json
from mbtf_core.console import clock
from mbtf_core.errors import InputError, UsageError
from mbtf_core.units import format_duration
from mbtf_fit.config import FitConfig
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.cost_study.pareto import weighted_line
from mbtf_pipeline.cost_study.runs import Chain, RunRequest, RunRunner
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run import layout_of
from mbtf_pipeline.run_folder import claim_run_folder, locked, write_run_record
from mbtf_pipeline.stages import hash_of

if TYPE_CHECKING:
    from mbtf_gen.forecast import Forecast

BUDGET_NAME = "budget.json"
BUDGET_FORMAT = "mbtf-budget"
BUDGET_SCHEMA = 2
# Shares of a chain's time that its pilots generate for, and the one taken without pilots.
SHARES = (0.15, 0.35, 0.6)
USUAL_SHARE = 0.35
# Shares that may come out.
LEAST_SHARE, LARGEST_SHARE = 0.08, 0.75
# Share of the budget that one pilot chain takes, and its shortest length in seconds.
PILOT, SHORTEST_PILOT = 0.04, 10.0
# The shortest budget worth splitting, seconds: below it starting up takes most.
SHORTEST = 60.0
# Test split of the pilot chains, whose paths are what their judges take.
_TEST, _TEST_SPP = "8192", 16
_FEWEST_QUERIES = 4096
# Seconds that a query takes at the least: that of a closed form, written to disk.
_CHEAPEST = 1e-8
# Shares of the free disk space and of the machine's memory that training queries may take.
_DISK, _MEMORY = 0.25, 0.5
# However long looking took, this share of the budget is spent.
_LEAST_LEFT = 0.25


@dataclass(frozen=True)
class Prices:
    """What a run takes, in seconds.

    Attributes
    ----------
    query : to generate a training query
    start : of generating besides, with the test split
    fit, fit_query : of a fit besides training, and of that by training query
    fits : number of fits
    """

    query: float
    start: float
    fit: float
    fit_query: float
    fits: int

    def spend(self, seconds: float, share: float, most: float = math.inf) -> tuple[float, float, float]:
        """(queries, seconds of making them, seconds of training) of so many seconds in all, where `share` of
        both makes queries, at most `most`; what is left over then is trained for."""
        left = seconds - self.start - self.fits * self.fit
        # Fits load what is made.
        both = left / (1 + self.fits * self.fit_query * share / self.query)
        queries = share * both / self.query
        if queries > most:
            queries, both = most, left - self.fits * self.fit_query * most
        return queries, queries * self.query, both - queries * self.query


@dataclass(frozen=True)
class Split:
    """How a budget is spent.

    Attributes
    ----------
    queries : training queries to generate
    generating, training : seconds meant for either; training is over all fits
    share : of generating in both
    pilots : (share, unexplained variance) of the pilot chains; none for short budgets
    pilot_seconds : what forecast and pilots took
    prices : by which it was reckoned
    """

    queries: int
    generating: float
    training: float
    share: float
    pilots: tuple[tuple[float, float], ...]
    pilot_seconds: float
    prices: Prices

    @property
    def beside(self) -> float:
        """Seconds that fits take besides training."""
        return self.prices.fits * (self.prices.fit + self.prices.fit_query * self.queries)

    def describe(self) -> str:
        """One line."""
        tried = ", ".join(f"{share:.0%} {error:.3f}" for share, error in self.pilots)
        how = f"pilots' unexplained variance by share of generating: {tried}" if tried else "a fixed share"
        return (
            f"budget: {clock(self.generating)} for {self.queries} queries, {clock(self.training)} of "
            f"training and {clock(self.beside)} beside it, after {clock(self.pilot_seconds)} of looking "
            f"({self.share:.0%} generating; {how})"
        )


def best_share(pilots: Sequence[tuple[float, float]]) -> float:
    """Share of the least error by a parabola through three (share, error), both in logarithms; the best of
    them where it has no least value, and always within the shares that may come out."""
    (x0, y0), (x1, y1), (x2, y2) = ((math.log(x), math.log(max(y, 1e-12))) for x, y in pilots)
    left, right = (y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1)
    bend = (right - left) / (x2 - x0)
    if bend > 0:
        vertex = 0.5 * (x0 + x1 - left / bend)
    else:
        vertex = math.log(min(pilots, key=lambda p: p[1])[0])
    # What lies outside of the pilots is a guess: no more than half a step beyond them.
    vertex = min(max(vertex, x0 - 0.5 * (x1 - x0)), x2 + 0.5 * (x2 - x1))
    return min(max(math.exp(vertex), LEAST_SHARE), LARGEST_SHARE)


def split_budget(
    recipe: Recipe, budget: float, folder: Path, command: str, tell: Callable[[str], None]
) -> Split:
    """How to spend a budget in seconds on a recipe; remembered in the run's folder, so that the same command
    goes on with the same split.

    Parameters
    ----------
    command : what the run is described by
    tell : called with a note after every pilot chain

    Training queries take at most a quarter of the free disk space, and no more memory than ``data.memory`` of
    the fits or half of the machine's, whichever is more: beyond both, training would wait for the disk.

    Raises
    ------
    UsageError : the budget is too short, or a model of the recipe learns from another layout
    InputError : the folder holds something else
    PartialError : something else works in it
    """
    if budget < SHORTEST:
        raise UsageError(
            f"{format_duration(budget)} is too short to split: starting up takes most of it",
            where="--budget",
            hint=f"give {format_duration(SHORTEST)} or more",
        )
    if any(layout_of(fit) != "shuffled" for fit in recipe.fit.values()):
        raise UsageError(
            "only models of the shuffled layout can share a budget",
            where="--budget",
            hint="leave out the fits of 'hierarchical'",
        )
    asked = recipe.model_dump(mode="json", include={"generate", "fit"})
    key = hash_of({"schema": BUDGET_SCHEMA, "budget": budget, "recipe": asked})
    claim_run_folder(folder)
    with locked(folder):
        split = _remembered(folder, key)
        if split is None:
            write_run_record(folder, recipe, command)
            split = _plan(recipe, budget, folder, tell)
            write_json(folder / BUDGET_NAME, {"format": BUDGET_FORMAT, "key": key, **asdict(split)})
    return split


def _remembered(folder: Path, key: str) -> Split | None:
    path = folder / BUDGET_NAME
    if not path.exists():
        return None
    try:
        data = read_json(path)
        if data.pop("format") != BUDGET_FORMAT or data.pop("key") != key:
            return None
        pilots = tuple((p[0], p[1]) for p in data["pilots"])
        return Split(**data | {"pilots": pilots, "prices": Prices(**data["prices"])})
    except (InputError, KeyError, TypeError, IndexError):
        return None


def most_queries(recipe: Recipe, folder: Path) -> int:
    """Training queries that disk and memory hold.

    Parameters
    ----------
    folder : that they are written to; it exists
    """
    from mbtf_fit.data.loader import QUERY_BYTES
    from mbtf_gen.forecast import row_bytes

    on_disk = _DISK * shutil.disk_usage(folder).free / row_bytes(holes=True)
    loaded = min(fit.data.memory for fit in recipe.fit.values()) / QUERY_BYTES
    # What is read from disk goes through the file system's memory.
    mapped = _MEMORY * physical_memory() / row_bytes(holes=True)
    return max(_FEWEST_QUERIES, int(min(on_disk, max(loaded, mapped))))


def physical_memory() -> float:
    """Bytes of the machine's memory; infinite where it does not say."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return math.inf


def _plan(recipe: Recipe, budget: float, folder: Path, tell: Callable[[str], None]) -> Split:
    from mbtf_gen.forecast import forecast
    from mbtf_gen.generation import Job, allocated
    from mbtf_gen.planning.effects_plan import plan_effects

    began = time.perf_counter()
    job = Job.of(recipe.generate, _material(recipe.generate))
    expected = forecast(job, allocated(job, plan_effects(job, pilots=False)))
    price, test = _prices(expected, job.queries("train"))
    pilots: list[tuple[float, float]] = []
    beside = 0.0, 0.0
    length = PILOT * budget
    if length >= SHORTEST_PILOT:
        try:
            pilots, beside = _pilots(recipe, length, price, tell)
        except InputError as error:
            tell(
                f"pilot failed: {error.what}; {USUAL_SHARE:.0%} of the time generates, as with short budgets"
            )
    # Data without variance, such as those of an even plane, leave nothing to be unexplained.
    pilots = pilots if all(math.isfinite(error) for _, error in pilots) else []
    share = best_share(pilots) if pilots else USUAL_SHARE
    looked = time.perf_counter() - began
    prices = Prices(price, test + expected.start, *beside, len(recipe.fit))
    left = max(budget - looked, _LEAST_LEFT * budget + prices.start + prices.fits * prices.fit)
    queries, generating, training = prices.spend(left, share, most_queries(recipe, folder))
    return Split(
        _two_digits(max(_FEWEST_QUERIES, queries)),
        round(generating + prices.start, 1),
        round(training, 1),
        round(share, 3),
        tuple(pilots),
        round(looked, 1),
        prices,
    )


def _material(config: GeneratorConfig) -> Any:
    from mbtf_gen.material.material import load_material

    return load_material(Path(config.material), config.geometry.tile)


def _prices(expected: Forecast, queries: int) -> tuple[float, float]:
    """(seconds of a training query, seconds of the test split)."""
    # What has a closed form takes no time that could be told from none.
    price = max(expected.query_seconds, _CHEAPEST)
    return price, max(0.0, expected.seconds - queries * price)


def _two_digits(count: float) -> int:
    digits = 10 ** max(0, len(str(int(count))) - 2)
    return max(digits, int(count / digits) * digits)


def _pilots(
    recipe: Recipe, length: float, price: float, tell: Callable[[str], None]
) -> tuple[list[tuple[float, float]], tuple[float, float]]:
    """(share, error) of each, and what a fit takes besides training: seconds, and seconds per query."""
    name, fit = next(iter(recipe.fit.items()))
    with tempfile.TemporaryDirectory(prefix="mbtf-budget-") as work:
        data = recipe.generate.model_dump(mode="json")
        data["queries"] |= {"test": _TEST, "test_spp": _TEST_SPP}
        workshop = RunRunner(GeneratorConfig.model_validate(data), Path(work), "", lambda note: None)
        out, beside = [], []
        most = most_queries(recipe, Path(work))
        for share in SHARES:
            queries = _two_digits(min(max(_FEWEST_QUERIES, share * length / price), most))
            trained = _with_time(fit, (1 - share) * length)
            # Where it trains is no option of the result, but of the time that it takes.
            where = trained.model_dump(mode="json", include={"device", "data"})
            options = {**trained.fields(), **where}
            wanted = RunRequest(queries, recipe.generate.queries.spp)
            chain = Chain("chain", name, f"{share:.0%}", wanted, options)
            point = workshop.measure(chain)
            out.append((share, point.error.value))
            spent = point.details["generation_seconds"] + point.details["training_seconds"]
            beside.append((float(queries), point.details["total_seconds"] - spent))
            tell(f"pilot: {share:.0%} of {length:.0f} s generating leaves {out[-1][1]:.3f}")
        return out, _line(beside)


def _line(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """(height at 0, slope) of a line through points by least squares, neither below 0."""
    xs, ys = zip(*points, strict=True)
    mean_x, mean_y = sum(xs) / len(xs), sum(ys) / len(ys)
    line = weighted_line(xs, ys, [1.0] * len(xs))
    slope = min(max(0.0, line.value if line is not None else 0.0), max(0.0, mean_y) / mean_x)
    return max(0.0, mean_y - slope * mean_x), slope


def _with_time(fit: FitConfig, seconds: float) -> FitConfig:
    return FitConfig.model_validate(
        {**fit.model_dump(), "training": {**fit.training.model_dump(), "time": seconds, "steps": None}}
    )


def within_budget(recipe: Recipe, split: Split) -> Recipe:
    """The recipe with the queries and training times of a split."""
    queries = recipe.generate.queries.model_copy(update={"train": str(split.queries)})
    each = max(1.0, round(split.training / len(recipe.fit), 1))
    return recipe.model_copy(
        update={
            "generate": recipe.generate.model_copy(update={"queries": queries}),
            "fit": {name: _with_time(fit, each) for name, fit in recipe.fit.items()},
        }
    )

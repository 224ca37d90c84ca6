"""Splits a total time between generating and training.

Three short pilot runs on the same material and machine generate for 15, 35 and 60 % of their time and train
for the rest. The share with the lowest error is used for the remaining time: the error changes slowly near
its minimum, so a finer search gains nothing. A short total time uses 35 % without pilots.

The time T left after the pilots pays for everything: with n queries, f fits, and the measured seconds g per
generated query, c of start and test split, and a + b n of each fit besides training (loading, calibration,
evaluation),

    T = c + n g + f (a + b n) + training,    n g = share (n g + training),

where a line through the pilots gives a and b, neither negative. Disk space and memory limit n; training gets
what is left.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from mbtf_core.atomic import read_json, write_json
from mbtf_core.config_file import deep_merge
from mbtf_core.digest import data_sha256
from mbtf_core.errors import InputError, UsageError
from mbtf_core.folders import check_folder, owned
from mbtf_core.units import clock, format_duration
from mbtf_fit.config import FitConfig
from mbtf_pipeline.cost_study.fit_runs import round_down
from mbtf_pipeline.cost_study.runs import DataRequest, Run, RunRunner, forecast_seconds
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run import layout_of
from mbtf_pipeline.run_folder import is_run, write_run_record

SPLIT_NAME = "time_split.json"
SPLIT_SCHEMA = 4
# Shares that the pilots generate for, and the one without pilots.
SHARES = (0.15, 0.35, 0.6)
DEFAULT_SHARE = 0.35
# Share of the total time that one pilot takes, and its shortest length in seconds.
PILOT, SHORTEST_PILOT = 0.04, 10.0
# The shortest total time, seconds: start-up takes most of a shorter one.
SHORTEST = 60.0
# Test set of the pilots: queries, and paths of each.
_TEST = (1 << 17, 8)
# Seconds of a fit besides training where there are no pilots.
_FIT = 2.0
_FEWEST_QUERIES = 4096
# Shares of the free disk space and of the machine's memory that training queries may take.
_DISK, _MEMORY = 0.25, 0.5
# Share of the total time that remains at least, however long the pilots took.
_LEAST_LEFT = 0.25


@dataclass(frozen=True)
class Split:
    """How a total time is spent."""

    # Training queries to generate.
    queries: int
    # Seconds of generating, of training all fits, and of fits besides training.
    generating: float
    training: float
    other: float
    # Share of generating in generating and training.
    share: float
    # (share, unexplained variance) of each pilot; empty for short times.
    pilots: list[list[float]]
    # Time of forecast and pilots.
    pilot_seconds: float

    def describe(self) -> str:
        """One line."""
        errors = ", ".join(f"{share:.0%} {error:.3f}" for share, error in self.pilots)
        how = f"pilots' unexplained variance by share: {errors}" if errors else "fixed share"
        return (
            f"time: {clock(self.generating)} for {self.queries} queries, {clock(self.training)} of training, "
            f"{clock(self.other)} of loading and evaluation, after {clock(self.pilot_seconds)} of pilots "
            f"({self.share:.0%} generating; {how})"
        )


def split_time(
    recipe: Recipe,
    seconds: float,
    folder: Path,
    command: str,
    progress: Callable[[str], None],
    share: float | None = None,
) -> Split:
    """How to spend a total time on a recipe; stored in the run's folder, so that the same command resumes
    with the same split. Without pilots where the share that generates is given."""
    if seconds < SHORTEST:
        problem = f"{format_duration(seconds)} is too short: starting up takes most of it"
        raise UsageError(problem, where="--time", hint=f"give {format_duration(SHORTEST)} or more")
    if any(layout_of(fit) != "shuffled" for fit in recipe.fit.values()):
        problem = "only models of the shuffled layout can share a time"
        raise UsageError(problem, where="--time", hint="leave out the fits of 'hierarchical'")
    options = recipe.model_dump(mode="json", include={"generate", "fit"})
    key = data_sha256({"schema": SPLIT_SCHEMA, "time": seconds, "share": share, "recipe": options})
    with owned(folder):
        check_folder(folder, is_run, "run")
        split = _stored(folder, key)
        if split is None:
            write_run_record(folder, recipe, command)
            split = _measure(recipe, seconds, share, folder, progress)
            write_json(folder / SPLIT_NAME, {"key": key, "split": asdict(split)})
    return split


def _stored(folder: Path, key: str) -> Split | None:
    try:
        data = read_json(folder / SPLIT_NAME)
        return Split(**data["split"]) if data["key"] == key else None
    except (InputError, KeyError, TypeError):
        return None


def _measure(
    recipe: Recipe, seconds: float, share: float | None, folder: Path, progress: Callable[[str], None]
) -> Split:
    start = time.perf_counter()
    query, generator = forecast_seconds(recipe.generate)
    most = _most_queries(folder)
    pilots: list[list[float]] = []
    fit, fit_query = _FIT, 0.0
    if share is None and PILOT * seconds >= SHORTEST_PILOT:
        try:
            pilots, (fit, fit_query) = _pilots(recipe, PILOT * seconds, query, most, progress)
        except InputError as error:
            progress(f"pilot failed: {error.what}; {DEFAULT_SHARE:.0%} of the time generates")
    # The values of a flat plane do not vary: their unexplained variance is not defined.
    pilots = pilots if all(math.isfinite(error) for _, error in pilots) else []
    if share is None:
        share = min(pilots, key=lambda p: p[1])[0] if pilots else DEFAULT_SHARE
    fits = len(recipe.fit)
    took = time.perf_counter() - start
    left = max(seconds - took, _LEAST_LEFT * seconds + generator + fits * fit) - generator
    # Of n queries, n (query / share + fits fit_query) is the time that is neither start nor `fit`.
    count = min(most, (left - fits * fit) / (query / share + fits * fit_query))
    queries = round_down(max(_FEWEST_QUERIES, count))
    other = fits * (fit + queries * fit_query)
    training = max(1.0 * fits, left - queries * query - other)
    generating = round(queries * query + generator, 1)
    return Split(queries, generating, round(training, 1), round(other, 1), share, pilots, round(took, 1))


def _pilots(
    recipe: Recipe, length: float, query: float, most: float, progress: Callable[[str], None]
) -> tuple[list[list[float]], tuple[float, float]]:
    """(share, error) of each pilot; seconds of a fit besides training: in any case, and for each query."""
    name, fit = next(iter(recipe.fit.items()))
    errors, counts, others = [], [], []
    with tempfile.TemporaryDirectory(prefix="mbtf-time-split-") as work:
        runner = RunRunner(recipe.generate, Path(work), "", lambda note: None, _TEST)
        for share in SHARES:
            queries = round_down(min(max(_FEWEST_QUERIES, share * length / query), most))
            trained = _with_time(fit, (1 - share) * length)
            # Device and memory are no part of `fields`, as they do not change the result.
            options = {**trained.fields(), **trained.model_dump(mode="json", include={"device", "data"})}
            data = DataRequest(queries, recipe.generate.queries.spp)
            found = runner.measure(Run("whole", name, f"{share:.0%}", data, options))
            runner.forget(data)
            d = found.details
            errors.append([share, found.error.value])
            counts.append(queries)
            others.append(d["total_seconds"] - d["generation_seconds"] - d["training_seconds"])
            progress(f"pilot: {share:.0%} of {length:.0f} s generating, error {found.error.value:.3f}")
    fixed, slope = nnls(np.column_stack([np.ones(len(counts)), counts]), others)[0]
    return errors, (float(fixed), float(slope))


def _most_queries(folder: Path) -> float:
    """Training queries that disk and memory hold. What is read from disk passes through the file system's
    memory."""
    from mbtf_gen.dataset.shard_io import row_bytes

    free = min(_DISK * shutil.disk_usage(folder).free, _MEMORY * _physical_memory())
    return max(_FEWEST_QUERIES, free / row_bytes(holes=True))


def _physical_memory() -> float:
    """Bytes of the machine's memory; infinite where it is unknown."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return math.inf


def _with_time(fit: FitConfig, seconds: float) -> FitConfig:
    data = deep_merge(fit.model_dump(), {"training": {"time": seconds, "steps": None}})
    return FitConfig.model_validate(data)


def with_split(recipe: Recipe, split: Split) -> Recipe:
    """The recipe with the queries and training times of a split."""
    queries = recipe.generate.queries.model_copy(update={"train": str(split.queries)})
    each = max(1.0, round(split.training / len(recipe.fit), 1))
    return recipe.model_copy(
        update={
            "generate": recipe.generate.model_copy(update={"queries": queries}),
            "fit": {name: _with_time(fit, each) for name, fit in recipe.fit.items()},
        }
    )

"""One run of the whole chain: training data of a size, a fit of a length, and its error on a test set.

All runs are evaluated on the same test set, which no fit is trained on: many queries of few paths, drawn by
highlights where these decide. With halves a, b of its values and a prediction p, ``E[(p - a)(p - b)]`` is the
squared error of p, free of the noise of the test values. Its error bar depends on the number of queries more
than on that of paths. Data and fits come from the generator and the fitter, called as the programs call them.
"""

from __future__ import annotations

import shlex
import shutil
import time
import timeit
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mbtf_core.config.settings import deep_merge, nested
from mbtf_core.files.atomic import data_sha256
from mbtf_core.stats import Estimate, unexplained_variance
from mbtf_fit.config import DEFAULT_MODEL, best_options
from mbtf_fit.sections import TimeBudget
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.run import generate
from mbtf_gen.planning.job import Job
from mbtf_pipeline.cost.measurement import Conditions, Configuration, Measurement

if TYPE_CHECKING:
    from mbtf_fit.data.queries import ShardQueries

# Shares of a study's time that comparisons of the generator and runs get. The rest is left for start-up, the
# test set, loading and evaluation. The first seconds are for runs alone.
GENERATOR, RUNS = 0.1, 0.7
RUNS_ALONE = 90.0
# Total times of runs, seconds: this one, twice, four times, ...; the share of each that generates.
SHORTEST = 6.0
SHARE, OTHER_SHARES = 0.35, (0.6, 0.15)
_FEWEST_QUERIES = 20_000
# Fewest training steps of a run: the error of a shorter fit says nothing about longer ones.
FEWEST_STEPS = 200
# Test queries, and paths of each.
TEST = (1 << 18, 16)
# The smallest split that the generator takes.
_NO_QUERIES = (1, 2)
# Pixels of a 1080p image with one query each; queries of one timed evaluation, and how often it is timed.
PIXELS = 1920 * 1080
_TIMED_QUERIES = 1 << 18
_TIMED = 5


@dataclass(frozen=True)
class Run(Configuration):
    """A run to measure: its training queries, and paths of each; options of the fitter by dotted name; and
    what is added to the study's seed, for data and fit."""

    queries: int
    spp: int
    fit: dict[str, Any]
    seed: int = 0

    @property
    def label(self) -> str:
        return f"{super().label}, seed + {self.seed}" if self.seed else super().label

    @property
    def key(self) -> dict[str, Any]:
        return {"queries": self.queries, "spp": self.spp, "seed": self.seed, "fit": self.fit}

    def planned_seconds(self, path_seconds: float, step_seconds: float = 0.0) -> float:
        """Seconds of generating and training, from those of a path and of a training step."""
        training = TimeBudget.parse(self.fit["training.time"]).seconds
        return self.queries * self.spp * path_seconds + max(training, FEWEST_STEPS * step_seconds)

    def command(self, conditions: Conditions) -> str:
        """The commands that reproduce it; the test split is that of the recipe."""
        seed = conditions.config.seed + self.seed
        own = f" --seed {seed}" if self.seed else ""
        options = self.fit | ({"seed": seed} if seed else {})
        flags = "".join(f" --set {shlex.quote(f'{k}={v}')}" for k, v in options.items())
        return (
            f"{conditions.command} --queries {self.queries} --spp {self.spp}{own} -o {self.folder}/shards && "
            f"mbtf-fit {self.folder}/shards{flags} -o {self.folder}/material"
        )

    def measure(self, conditions: Conditions) -> Measurement:
        """Generate the data, fit, and evaluate; an InputError where the fit diverged, a PartialError where
        the disk is full."""
        from mbtf_fit import FitConfig, fit

        test = test_set(conditions)
        start = time.perf_counter()
        shards, generation_seconds = _generated(conditions, self.seed, (self.queries, self.spp), _NO_QUERIES)
        options = nested({"seed": conditions.config.seed + self.seed, **self.fit})
        out = conditions.folder / f"fit-{data_sha256(self.key)[:12]}"
        shutil.rmtree(out, ignore_errors=True)
        result = fit(FitConfig.model_validate(options), shards, out)
        error = unexplained_variance(result.material.predict(test), test.value_a, test.value_b, test.weight)
        seconds = generation_seconds + result.total_seconds
        details = {
            "queries": float(self.queries),
            "spp": float(self.spp),
            "generation_seconds": generation_seconds,
            "training_seconds": result.seconds,
            "training_steps": float(result.history[-1]["step"]),
            "overhead_seconds": result.total_seconds - result.seconds,
            "total_seconds": seconds,
            "evaluation_ms_1080p": 1e3 * _evaluation_seconds(result.material, test),
            "bytes": float(sum(p.stat().st_size for p in out.glob("weights*"))),
        }
        for used in (shards, out):
            shutil.rmtree(used, ignore_errors=True)
        # Of everything but the test set.
        details["run_seconds"] = time.perf_counter() - start
        details["evaluating_seconds"] = details["run_seconds"] - seconds
        took = Estimate(seconds, 0.0, 1)
        command = self.command(conditions)
        return Measurement(self.study, self.series, self.name, command, took, error, details=details)


def planned_runs(seconds: float, spp: int, path_seconds: float, step_seconds: float = 0.0) -> list[Run]:
    """All runs of a study of some seconds, in the order of measuring, with `spp` paths per query of
    `path_seconds` each, and no fewer training steps than :data:`FEWEST_STEPS` of `step_seconds` each.

    Total times double: first each of them, then a second seed of all but the longest. The time that is then
    left goes to other shares of generating, shortest first, and to further second seeds.
    """
    left = seconds * RUNS
    totals = [SHORTEST]
    while (1 - SHARE) * totals[0] < FEWEST_STEPS * step_seconds:
        totals[0] *= 2
    while 2 * sum(totals) + 2 * totals[-1] <= left:
        totals.append(2 * totals[-1])
    others = list(product(OTHER_SHARES, (0, 1)))
    order = [(total, SHARE, 0) for total in totals] + [(total, SHARE, 1) for total in totals]
    order += [(total, share, seed) for total in totals for share, seed in sorted(others, key=itemgetter(1))]
    runs: list[Run] = []
    for total, share, seed in order:
        if runs and (total > left or (1 - share) * total < FEWEST_STEPS * step_seconds):
            continue
        left -= total
        queries = _round_down(max(_FEWEST_QUERIES, share * total / (spp * path_seconds)))
        training = (1 - share) * total
        fit = {
            "model": DEFAULT_MODEL,
            **best_options(training),
            "training.time": str(TimeBudget(round(training, 1), FEWEST_STEPS)),
        }
        series = f"{100 * share:.0f}% of the time for generating"
        runs.append(Run("run", series, f"planned for {total:g} s", queries, spp, fit, seed))
    return runs


@lru_cache(maxsize=1)
def test_set(conditions: Conditions) -> ShardQueries:
    """The test queries of all runs, which this process keeps."""
    from mbtf_core.data.dataset import Dataset
    from mbtf_fit.data.loader import load_split

    folder, _ = _generated(conditions, 0, _NO_QUERIES, TEST)
    found = load_split(Dataset.open(folder), "test")
    shutil.rmtree(folder, ignore_errors=True)
    return found


def _generated(
    conditions: Conditions, seed: int, train: tuple[int, int], test: tuple[int, int]
) -> tuple[Path, float]:
    """Folder of a new data set with (queries, paths of each) of both splits, and the seconds it took."""
    queries = {"train": str(train[0]), "spp": train[1], "test": str(test[0]), "test_spp": test[1]}
    changes = {"seed": conditions.config.seed + seed, "queries": {**queries, "layout": "shuffled"}}
    data = deep_merge(conditions.config.model_dump(mode="json"), changes)
    folder = conditions.folder / f"data-{data_sha256(data)[:12]}"
    # Data that an interrupted study left behind were not timed.
    shutil.rmtree(folder, ignore_errors=True)
    start = time.perf_counter()
    # Of a configuration, it would log the material's warnings for every data set.
    generate(Job.load(GeneratorConfig.model_validate(data)), folder)
    return folder, time.perf_counter() - start


def _evaluation_seconds(material: Any, test: ShardQueries) -> float:
    """Seconds for one query per pixel of 1080p, at random queries."""
    rows = np.resize(np.arange(len(test)), _TIMED_QUERIES)
    arrays = [getattr(test, name)[rows] for name in ("u", "sigma", "omega_i", "omega_o")]
    # The smallest: the disk may still be writing generated data.
    timer = time.perf_counter
    seconds = min(timeit.repeat(lambda: material.evaluate(*arrays), timer=timer, number=1, repeat=_TIMED))
    return seconds * PIXELS / _TIMED_QUERIES


def _round_down(count: float) -> int:
    """A number of queries with two significant digits."""
    digits = 10 ** max(0, len(str(int(count))) - 2)
    return max(1, int(count / digits) * digits)

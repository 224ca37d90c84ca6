"""One run of the whole chain: training data of a size, a fit of a length, and its error on a test set.

All runs of a seed are evaluated on the same test set, which no fit is trained on: many queries of few paths.
With halves a, b of its values and a prediction p, ``E[(p - a)(p - b)]`` is the squared error of p,
free of the noise of the test values. Its error bar depends on the number of queries more than on that of
paths. Data and fits come from the generator and the fitter, called as the programs call them.
"""

from __future__ import annotations

import shutil
import time
import timeit
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mbtf_core.errors import InputError
from mbtf_core.files.digest import data_sha256
from mbtf_core.stats import Estimate, unexplained_variance
from mbtf_core.units import parse_duration
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.run import generate
from mbtf_gen.job import Job
from mbtf_pipeline.cost.measurements import Configuration, Measurement

if TYPE_CHECKING:
    from mbtf_fit.data.queries import ShardQueries

# Test queries, and paths of each.
TEST = (1 << 20, 8)
# The smallest split that the generator takes.
_NO_QUERIES = (1, 2)
# Pixels of a 1080p image with one query each; queries of one timed evaluation, and how often it is timed.
PIXELS = 1920 * 1080
_TIMED_QUERIES = 1 << 18
_TIMED = 5
_OVERHEAD = 2.0
# Seconds of a query at least: that of a closed form, written to disk.
_CHEAPEST = 1e-8


@dataclass(frozen=True)
class DataRequest:
    """Training data: number of queries, paths of each, and an offset that is added to the study's seed."""

    queries: int
    spp: int
    seed: int = 0


@dataclass(frozen=True)
class Run(Configuration):
    """A run to measure: its data, whose seed offset is that of the fit, too, and nested options of the
    fitter."""

    data: DataRequest
    fit: dict[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        seed = f", seed + {self.data.seed}" if self.data.seed else ""
        return f"{super().label}{seed}"

    @property
    def key(self) -> dict[str, Any]:
        return {**asdict(self.data), "fit": self.fit}


@dataclass
class RunRunner:
    """Generates data and fits models in a working folder."""

    config: GeneratorConfig
    folder: Path
    # The generator's, with the study's configuration.
    command: str
    progress: Callable[[str], None]
    # Number of test queries, and paths of each.
    test: tuple[int, int] = field(default_factory=lambda: TEST)
    # Time to generate a query over its number of paths.
    path_seconds: float = 0.0
    # Seconds by which a run exceeds generating and training: the most of all so far, or a guess.
    overhead: float = _OVERHEAD
    # By seed.
    test_sets: dict[int, ShardQueries] = field(default_factory=dict)
    test_seconds: float = 0.0

    def clear(self) -> None:
        """Remove data and fits."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _generate(self, seed: int, train: tuple[int, int], test: tuple[int, int]) -> tuple[Path, float]:
        """Folder of a new data set with (queries, paths of each) of both splits, and the seconds it took."""
        data = self.config.model_dump(mode="json")
        data["seed"] += seed
        data["queries"] |= {"train": str(train[0]), "spp": train[1], "layout": "shuffled"}
        data["queries"] |= {"test": str(test[0]), "test_spp": test[1]}
        config = GeneratorConfig.model_validate(data)
        folder = self.folder / f"data-{data_sha256(data)[:12]}"
        # Data that an interrupted study left behind were not timed.
        shutil.rmtree(folder, ignore_errors=True)
        start = time.perf_counter()
        # `Job.prepare` would log the material's warnings for every data set.
        job = Job.load(config)
        generate(job, folder)
        return folder, time.perf_counter() - start

    def work_left(self, seconds: float) -> float:
        """Seconds of work that can be done in a time."""
        return seconds

    def expected_seconds(self, run: Run) -> float:
        """Expected time of measuring a run."""
        test = 0.0 if run.data.seed in self.test_sets else self.test_seconds
        return test + self.planned_seconds(run) + self.overhead

    def planned_seconds(self, run: Run) -> float:
        """Seconds of generating and training."""
        generating = run.data.queries * run.data.spp * self.path_seconds
        return generating + parse_duration(run.fit["training"]["time"])

    def test_set(self, seed: int) -> ShardQueries:
        """The test queries of all runs with an offset of the seed."""
        if seed not in self.test_sets:
            from mbtf_core.data.dataset import Dataset
            from mbtf_fit.data.loader import load_split

            self.progress("test set")
            folder, self.test_seconds = self._generate(seed, _NO_QUERIES, self.test)
            if len(self.test_sets) > 1:
                # Further seeds are measured one after the other.
                self.test_sets.popitem()
            self.test_sets[seed] = load_split(Dataset.open(folder), "test")
            shutil.rmtree(folder, ignore_errors=True)
        return self.test_sets[seed]

    def measure(self, run: Run) -> Measurement:
        """Generate the data, fit, and evaluate."""
        from mbtf_fit import FitConfig, fit

        test = self.test_set(run.data.seed)
        start, planned = time.perf_counter(), self.planned_seconds(run)
        self.progress(run.label)
        train = (run.data.queries, run.data.spp)
        folder, generation_seconds = self._generate(run.data.seed, train, _NO_QUERIES)
        config = FitConfig.model_validate({"seed": self.config.seed + run.data.seed, **run.fit})
        out = self.folder / f"fit-{data_sha256(run.key)[:12]}"
        shutil.rmtree(out, ignore_errors=True)
        result = fit(config, folder, out)
        error = unexplained_variance(result.material.predict(test), test.value_a, test.value_b)
        details = {
            "queries": float(run.data.queries),
            "spp": float(run.data.spp),
            "generation_seconds": generation_seconds,
            "training_seconds": result.seconds,
            "total_seconds": generation_seconds + result.total_seconds,
            "evaluation_ms_1080p": 1e3 * _evaluation_seconds(result.material, test),
            "bytes": float(sum(p.stat().st_size for p in out.glob("weights*"))),
        }
        for used in (folder, out):
            shutil.rmtree(used, ignore_errors=True)
        self.overhead = max(self.overhead, time.perf_counter() - start - planned)
        seconds = Estimate(details["total_seconds"], 0.0, 1)
        command = self.command_of(run)
        return Measurement(run.study, run.series, run.name, command, seconds, error, details=details)

    def measure_all(self, runs: Iterable[tuple[int, Run]]) -> Iterator[tuple[int, Run, Measurement | str]]:
        """Measure numbered runs; yields number, run, and its measurement or why it failed. A run is taken
        once the one before has been measured."""
        for number, run in runs:
            try:
                measured: Measurement | str = self.measure(run)
            except InputError as error:
                measured = error.what
            yield number, run, measured

    def command_of(self, run: Run) -> str:
        """The command that reproduces a run; the test split is that of the recipe."""
        fit = _flat(run.fit)
        seed = self.config.seed + run.data.seed
        own = f" --seed {seed}" if run.data.seed else ""
        if seed:
            fit["seed"] = seed
        flags = "".join(f" --set {name}={value}" for name, value in fit.items())
        return (
            f"{self.command} --queries {run.data.queries} --spp {run.data.spp}{own} -o shards/ && "
            f"mbtf-fit shards/{flags} -o material/"
        )


def forecast_seconds(config: GeneratorConfig) -> float:
    """Seconds of a training query, by a forecast."""
    from mbtf_gen.forecast import forecast

    job = Job.load(config)
    return max(forecast(job).query_seconds, _CHEAPEST)


def _flat(options: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested options by dotted name."""
    out: dict[str, Any] = {}
    for name, value in options.items():
        out |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return out


def _evaluation_seconds(material: Any, test: ShardQueries) -> float:
    """Seconds for one query per pixel of 1080p, at random queries."""
    rows = np.resize(np.arange(len(test)), _TIMED_QUERIES)
    arrays = [getattr(test, name)[rows] for name in ("u", "sigma", "omega_i", "omega_o")]
    # The smallest: the disk may still be writing generated data.
    timer = time.perf_counter
    seconds = min(timeit.repeat(lambda: material.evaluate(*arrays), timer=timer, number=1, repeat=_TIMED))
    return seconds * PIXELS / _TIMED_QUERIES

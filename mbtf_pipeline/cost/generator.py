"""Time and error of the generator's configurations; the error of M is split into bias and noise.

A configuration is compared with a reference at the same queries. With halves a, b of the configuration and
r, s of the reference, (a, r) independent of (b, s), ``E[(a - r)(b - s)]`` is the squared bias, free of the
noise of both. Within a half both use the same random numbers, so most of the noise cancels in the differences
and biases far below the noise are significant. ``E[(a - b)²/4]`` is the variance of the configuration's
noise. Both are given as root mean squares relative to the mean value of the reference.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.config.settings import deep_merge, nested
from mbtf_core.data.schema import Queries
from mbtf_core.errors import InputError
from mbtf_core.stats import Estimate, mean_estimate, signal_variance
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.planning.adaptive import estimate_shard
from mbtf_gen.planning.forecast import median_estimate
from mbtf_gen.planning.job import Job, split_spp, split_target
from mbtf_gen.planning.run_plan import allocate, plan_effects
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Stream
from mbtf_gen.tile.protocol import Tile
from mbtf_pipeline.cost.measurement import Conditions, Configuration, Measurement

PATHS = (2, 4, 8, 16, 32, 64, 128)
TARGETS = ("40%", "20%", "10%")
DEPTHS = (1, 2, 3, 4, 6, 0)
# Cells across relative to the recipe's mesh, and at most.
MESH_FACTORS = (0.25, 0.5, 1.0, 2.0)
FINEST_MESH = 1024
# All queries get equally many paths, except where allocations are compared.
UNIFORM = {"queries.allocation": "uniform"}
# Queries of one batch of the reference, and paths of each there and in the configuration.
BIAS_QUERIES, BIAS_SPP = 1 << 14, 64
_MOST_BIAS_BATCHES = 16
# Paths of one timed batch, and the fewest batches. Closed forms take fewer paths per query than counted here.
_BATCH_PATHS = 1 << 19
_FEWEST_BATCHES = 8
_FEWEST_PATHS = 2.0
# Relative half-width of a 95% interval to aim at, and that half-width over the standard error.
_HALF_WIDTH, _NORMAL = 0.1, 1.96
# Squared biases below the square of this are negligible.
_NEGLIGIBLE = 0.005
# Relative standard deviation of the values below which a fit has nothing to learn.
_LEAST_VARIATION = 0.005
# Random streams of the study stand for shards of so many queries, from these numbers on.
SHARD = 1 << 14
_FIRST_REFERENCE, _FIRST_BATCH = 5_001, 10_001
# Queries that measure how many paths a batch takes.
_PROBE = 2048

Halves = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True)
class GeneratorConfiguration(Configuration):
    """A configuration of the generator: options that differ from the recipe, and those of its reference (None
    where only paths per query differ)."""

    changes: dict[str, Any]
    against: dict[str, Any] | None = field(default_factory=dict)

    @property
    def key(self) -> dict[str, Any]:
        return {"changes": self.changes, "against": self.against}

    def command(self, conditions: Conditions) -> str:
        """The generator's command with the study's configuration, and the changed options."""
        sets = "".join(f" --set {name}={value}" for name, value in self.changes.items())
        return f"{conditions.command}{sets} -o {self.folder}"

    def measure(self, conditions: Conditions) -> Measurement:
        """Measure it for the time of the conditions."""
        found = benchmark_of(conditions).measure(self.changes, self.against, conditions.seconds)
        spp = self.changes.get("queries.spp")
        details = {} if spp is None else {"spp": float(spp)}
        command = self.command(conditions)
        return Measurement(self.study, self.series, self.name, command, *found, details=details)


def _halves(job: Job, estimator: Any, queries: Queries, spp: int, shard: int) -> Halves:
    """Both halves (n, 3) of values, with the random numbers of a shard."""
    found = estimator.estimate(queries, spp, Stream(job.config.seed, "test", shard))
    return found.value_a.astype(np.float64), found.value_b.astype(np.float64)


class Reference:
    """Values of a configuration with all effects and unlimited paths, made when they are first needed."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.estimator = build_estimator(job, plan_effects(job))
        self._batches: list[tuple[Queries, Halves]] = []

    @cached_property
    def mean(self) -> float:
        """Mean value over the first batch, 1/sr."""
        return float(np.mean(self.batch(0)[1]))

    def batch(self, number: int) -> tuple[Queries, Halves]:
        """Queries, and both halves (n, 3) of the values there; batches are made in their order."""
        if number == len(self._batches):
            shard = _FIRST_REFERENCE + number
            queries = self.job.query_plan.draw("test", shard, BIAS_QUERIES)
            self._batches.append((queries, _halves(self.job, self.estimator, queries, BIAS_SPP, shard)))
        return self._batches[number]


class GeneratorBenchmark:
    """Measures configurations of one material against references with all effects and unlimited paths. The
    finest level is that of the recipe's generator, so that all have equal queries."""

    def __init__(self, config: GeneratorConfig, material: Tile) -> None:
        self.config, self.material = config, material
        self._references: dict[str, Reference] = {}

    def job(self, changes: dict[str, Any]) -> Job:
        """The job with options changed, by dotted name."""
        fixed = {
            "queries.resolution": 1 << Job.of(self.config, self.material).lattice.finest,
            "queries.layout": "shuffled",
            "output.shard_queries": SHARD,
        }
        data = deep_merge(self.config.model_dump(mode="json"), nested({**fixed, **changes}))
        return Job.of(GeneratorConfig.model_validate(data), self.material)

    def reference(self, changes: dict[str, Any]) -> Reference:
        """The reference with these options."""
        key = repr(changes)
        if key not in self._references:
            job = self.job({"effects.mode": "all", "transport.max_depth": 0, **changes})
            self._references[key] = Reference(job)
        return self._references[key]

    def check_variation(self) -> None:
        """Refuse a material that gives a fit nothing to learn: it reflects nothing, or the same
        everywhere."""
        reference, where = self.reference({}), self.config.material
        if not reference.mean > 0:
            hint = "study a material with a base color or gloss"
            raise InputError("reflects nothing: every value is 0", where=where, hint=hint)
        variance = signal_variance(*reference.batch(0)[1])
        if variance.value + 2 * variance.error < (_LEAST_VARIATION * reference.mean) ** 2:
            problem = "reflects the same everywhere and in all directions: there is nothing to fit"
            raise InputError(problem, where=where, hint="study a material with displacement or textures")

    def measure(
        self, changes: dict[str, Any], against: dict[str, Any] | None, seconds: float
    ) -> tuple[Estimate, Estimate, Estimate | None, Estimate]:
        """(seconds per million queries, error, bias, noise) of a configuration; errors are root mean squares
        relative to the mean value of the reference. Without options of a reference only paths per query
        differ, which adds no bias. Noise and bias take at most so many seconds each."""
        noise, time_per_million = self._noise(self.job(changes), seconds, self.reference(against or {}).mean)
        if against is None:
            return time_per_million, _root(noise), None, _root(noise)
        bias = self._bias(self.job(changes), self.reference(against), seconds)
        # A squared bias that noise made negative counts as none.
        square = Estimate(max(bias.value, 0.0) + noise.value, math.hypot(bias.error, noise.error), noise.n)
        return time_per_million, _root(square), _root(bias), _root(noise)

    def _bias(self, job: Job, reference: Reference, seconds: float) -> Estimate:
        """Squared bias relative to the squared mean value."""
        estimator = build_estimator(job, plan_effects(job))
        start = time.perf_counter()
        squares: list[NDArray[np.float64]] = []
        while True:
            queries, (r, s) = reference.batch(len(squares))
            a, b = _halves(job, estimator, queries, BIAS_SPP, _FIRST_REFERENCE + len(squares))
            squares.append(((a - r) * (b - s)).mean(axis=1) / reference.mean**2)
            square = mean_estimate(np.concatenate(squares))
            enough = _NORMAL * square.error <= max(2 * _HALF_WIDTH * square.value, _NEGLIGIBLE**2)
            late = time.perf_counter() - start > seconds or len(squares) == _MOST_BIAS_BATCHES
            if enough or late:
                return square

    def _noise(self, job: Job, seconds: float, mean: float) -> tuple[Estimate, Estimate]:
        """Noise variance of one query relative to the squared mean value, and seconds per million queries.

        Queries get paths as in a data set: equally many, more where more noise is expected, or as many as a
        target error takes. The pilot of that allocation is not timed: it runs once per data set.
        """
        plan = allocate(job, plan_effects(job))
        estimator = build_estimator(job, plan.effects)
        target, spp = split_target(job.config, "train"), split_spp(job.config, "train")

        def batch(shard: int, count: int) -> tuple[Any, float]:
            queries = job.query_plan.draw("test", shard, count)
            stream = Stream(job.config.seed, "test", shard)
            start = time.perf_counter()
            found = estimate_shard(estimator, queries, spp, target, stream, plan.allocation)
            return found, (time.perf_counter() - start) / count * 1e6

        paths = batch(_FIRST_BATCH - 1, _PROBE)[0].paths / _PROBE
        count = round(_BATCH_PATHS / max(paths, _FEWEST_PATHS))
        squares: list[NDArray[np.float64]] = []
        times: list[float] = []
        began = time.perf_counter()
        while True:
            found, seconds_per_million = batch(_FIRST_BATCH + len(squares), count)
            times.append(seconds_per_million)
            squares.append(((found.value_a.astype(np.float64) - found.value_b) ** 2 / 4.0).mean(axis=1))
            variance = mean_estimate(np.concatenate(squares)).scaled(1.0 / mean**2)
            # The 95% interval of its root.
            narrow = _NORMAL * variance.error <= 2 * _HALF_WIDTH * variance.value
            late = time.perf_counter() - began > seconds
            if len(squares) >= _FEWEST_BATCHES and (narrow or late):
                # The first batch may compile kernels.
                return variance, median_estimate(times[1:])


def _root(square: Estimate) -> Estimate:
    """Root of a measured square. Where the square is not significant, the error bar of first order does not
    exist; the root of the square's error bar takes its place."""
    value = math.sqrt(max(square.value, 0.0))
    if square.value <= 2.0 * square.error:
        return Estimate(value, math.sqrt(square.error), square.n)
    return Estimate(value, square.error / (2.0 * value), square.n)


@lru_cache(maxsize=1)
def benchmark_of(conditions: Conditions) -> GeneratorBenchmark:
    """The benchmark of a study, which this process keeps for its references."""
    job = Job.load(conditions.config)
    return GeneratorBenchmark(job.config, job.material)


def generator_configurations(benchmark: GeneratorBenchmark) -> Iterator[GeneratorConfiguration]:
    """All configurations, the most important first: the recipe's own number of paths sets the rate of
    :func:`path_seconds`."""

    def paths(series: str, name: str, **changes: Any) -> GeneratorConfiguration:
        options = {f"queries.{key}": value for key, value in changes.items()}
        return GeneratorConfiguration("paths", series, name, options, None)

    own = benchmark.config.queries.spp
    for n in sorted(PATHS, key=lambda n: abs(math.log(n / own))):
        yield paths("uniform", f"{n} paths", allocation="uniform", spp=n)
    everything = plan_effects(benchmark.job({"effects.mode": "all"}), pilots=False)
    modes = {"auto": "auto", "all": "all"}
    # An effect that the material does not have cannot be left out.
    modes |= {f"without {e.name}": f"all,-{e.name}" for e in everything.effects if e.on and e.present}
    for name, mode in modes.items():
        yield GeneratorConfiguration("effects", "", name, {**UNIFORM, "effects.mode": mode})
    grid = benchmark.job({}).material.grid
    if grid is not None:
        across = grid.z.shape[1]
        sizes = sorted({max(8, min(FINEST_MESH, round(f * across))) for f in MESH_FACTORS} | {across})
        for cells in sizes:
            changes, against = {**UNIFORM, "geometry.mesh": cells}, {"geometry.mesh": sizes[-1]}
            yield GeneratorConfiguration("mesh", "", f"{cells} cells", changes, against)
    for depth in DEPTHS:
        name = f"{depth} interaction{'s' * (depth > 1)}" if depth else "no limit"
        changes = {**UNIFORM, "transport.max_depth": depth, "effects.mode": "all"}
        yield GeneratorConfiguration("interactions", "", name, changes)
    for n in PATHS[1::2]:
        yield paths("by expected noise", f"{n} paths", allocation="noise", spp=n)
    for error in TARGETS:
        yield paths("by target error", error, target_error=error)


def path_seconds(found: Sequence[Measurement], spp: int) -> float:
    """Seconds of generating a query over its number of paths, as measured with the number next to `spp`."""
    rates = {m.details["spp"]: m.seconds.value for m in found if m.series == "uniform"}
    nearest = min(rates, key=lambda n: abs(math.log(n / spp)))
    return rates[nearest] / (1e6 * nearest)

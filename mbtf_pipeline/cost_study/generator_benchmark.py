"""Time and error of the generator's configurations; the error of M is split into bias and noise.

A configuration is compared with a reference at the same queries. With halves a, b of the configuration and
r, s of the reference, (a, r) independent of (b, s), ``E[(a - r)(b - s)]`` is the squared bias, free of the
noise of both. Within a half both use the same random numbers, so most of the noise cancels in the differences
and biases far below the noise are significant. ``E[(a - b)²/4]`` is the variance of the configuration's
noise. Both are given as root mean squares relative to the mean value of the reference; the error of that mean
is part of their error bars.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.stats import Estimate, mean_estimate
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job, split_spp, split_target
from mbtf_gen.material.material import Material
from mbtf_gen.planning.adaptive import estimate_shard
from mbtf_gen.planning.effects_plan import plan_effects
from mbtf_gen.planning.run_plan import allocate
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Stream
from mbtf_gen.sampling.query_sampler import Queries
from mbtf_pipeline.cost_study.measurements import HALF_WIDTH, NORMAL

# Queries of one batch of the reference, and paths of each there and in the configuration.
BIAS_QUERIES, BIAS_SPP = 1 << 14, 64
_MOST_BIAS_BATCHES = 16
# Batches of queries for the mean value, and paths of each query.
_MEAN_BATCHES, _MEAN_QUERIES, _MEAN_SPP = 4, 1 << 17, 2
# Paths of one timed batch, and the fewest batches. Closed forms take fewer paths per query than counted here.
_BATCH_PATHS = 1 << 19
_FEWEST_BATCHES = 8
_FEWEST_PATHS = 2.0
# Squared biases below the square of this are negligible.
_NEGLIGIBLE = 0.005
# Random streams of the study stand for shards of so many queries, from these numbers on.
SHARD = 1 << 14
_FIRST_MEAN, _FIRST_REFERENCE, _FIRST_BATCH = 1_001, 5_001, 10_001
# Queries that measure how many paths a target error takes.
_PROBE = 2048


@dataclass(frozen=True)
class _Reference:
    """Queries and both halves (n, 3) of the reference's values there."""

    queries: Queries
    a: NDArray[np.float64]
    b: NDArray[np.float64]


@dataclass
class GeneratorBenchmark:
    """Measures configurations of one material against references with all effects and unlimited paths.

    Parameters
    ----------
    config : the recipe's generator; its finest level is fixed, so that all configurations have equal queries
    seed : of queries and paths
    """

    config: GeneratorConfig
    material: Material
    seed: int
    _cache: dict[str, Any] = field(default_factory=dict, repr=False)

    def job(self, changes: dict[str, Any]) -> Job:
        """The job with options changed, by dotted name."""
        data = self.config.model_dump(mode="json")
        fixed = {
            "queries.resolution": 1 << Job(self.config, self.material).lattice.finest,
            "queries.layout": "shuffled",
            "output.shard_queries": SHARD,
        }
        for name, value in {**fixed, **changes}.items():
            section, _, key = name.rpartition(".")
            (data[section] if section else data)[key] = value
        return Job(GeneratorConfig.model_validate({**data, "seed": self.seed}), self.material)

    def _queries(self, job: Job, shard: int, count: int) -> Queries:
        """Queries of a test split, one leading axis."""
        return job.query_plan.draw("test", shard, count)

    def _once(self, make: Callable[..., Any], changes: dict[str, Any], *rest: int) -> Any:
        """What `make` gives for a reference with these options, made once."""
        key = f"{make.__name__} {sorted(changes.items())} {rest}"
        if key not in self._cache:
            self._cache[key] = make(changes, *rest)
        return self._cache[key]

    def reference(self, changes: dict[str, Any], batch: int) -> _Reference:
        """One batch of the reference with these options."""
        found: _Reference = self._once(self._make_reference, changes, batch)
        return found

    def _make_reference(self, changes: dict[str, Any], batch: int) -> _Reference:
        job, estimator = self._once(self._make_estimator, changes)
        queries = self._queries(job, _FIRST_REFERENCE + batch, BIAS_QUERIES)
        return _Reference(queries, *self._bias_halves(estimator, queries, batch, BIAS_SPP))

    def mean(self, changes: dict[str, Any]) -> Estimate:
        """Mean value of the reference with these options, 1/sr."""
        found: Estimate = self._once(self._make_mean, changes)
        return found

    def _estimator(self, changes: dict[str, Any]) -> tuple[Job, Any]:
        key = _key(changes)
        if key not in self._estimators:
            job = self.job({"effects.mode": "all", "transport.max_depth": 0, **changes})
            self._estimators[key] = job, build_estimator(job, plan_effects(job))
        return self._estimators[key]

    def _bias_halves(
        self, estimator: Any, queries: Queries, batch: int, spp: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Both halves (n, 3) of values with the random numbers of a batch of the reference."""
        found = estimator.estimate(queries, spp, Stream(self.seed, "test", _FIRST_REFERENCE + batch))
        return found.value_a.astype(np.float64), found.value_b.astype(np.float64)

    def measure(
        self, changes: dict[str, Any], against: dict[str, Any] | None, seconds: float
    ) -> tuple[Estimate, Estimate, Estimate | None, Estimate]:
        """(seconds per million queries, error, bias, noise) of a configuration; errors are root mean squares
        relative to the mean value of the reference.

        Parameters
        ----------
        changes : options of the configuration
        against : options of its reference; None where only paths per query differ, which adds no bias
        seconds : largest time of each of noise and bias; less once the error bars are small
        """
        mean = self.mean(against or {})
        noise, time_per_million = self.noise(self.job(changes), seconds, mean.value)
        root = _relative_to(_root(noise), mean)
        if against is None:
            return time_per_million, root, None, root
        bias = self.bias(changes, against, seconds)
        # A squared bias that noise made negative counts as none.
        square = Estimate(max(bias.value, 0.0) + noise.value, math.hypot(bias.error, noise.error), noise.n)
        error, root_bias = (_relative_to(_root(e), mean) for e in (square, bias))
        return time_per_million, error, root_bias, root

    def bias(
        self, changes: dict[str, Any], against: dict[str, Any], seconds: float, spp: int = BIAS_SPP
    ) -> Estimate:
        """Squared bias relative to the squared mean value.

        Parameters
        ----------
        spp : paths of each query; the expected value does not depend on them
        """
        job = self.job(changes)
        estimator = build_estimator(job, plan_effects(job))
        mean = self.mean(against).value
        start = time.perf_counter()
        squares: list[NDArray[np.float64]] = []
        while True:
            reference = self.reference(against, len(squares))
            a, b = self._bias_halves(estimator, reference.queries, len(squares), spp)
            squares.append(((a - reference.a) * (b - reference.b)).mean(axis=1) / mean**2)
            square = mean_estimate(np.concatenate(squares))
            enough = NORMAL * square.error <= max(2 * HALF_WIDTH * square.value, _NEGLIGIBLE**2)
            late = time.perf_counter() - start > seconds or len(squares) == _MOST_BIAS_BATCHES
            if enough or late:
                return square

    def noise(self, job: Job, seconds: float, mean: float) -> tuple[Estimate, Estimate]:
        """Noise variance of one query relative to the squared mean value, and seconds per million queries.

        Queries get paths as in a data set: equally many, more where more noise is expected, or as many as a
        target error takes. The pilot of that allocation is not timed: it runs once per data set.
        """
        plan = allocate(job, plan_effects(job))
        estimator = build_estimator(job, plan.effects)
        target, spp = split_target(job.config, "train"), split_spp(job.config, "train")
        paths: float = spp
        if target is not None:
            probe = self._queries(job, _FIRST_BATCH - 1, _PROBE)
            stream = Stream(self.seed, "test", _FIRST_BATCH - 1)
            paths = estimate_shard(estimator, probe, spp, target, stream, plan.allocation).paths / _PROBE
        count = max(1, round(_BATCH_PATHS / max(paths, _FEWEST_PATHS)))
        squares: list[NDArray[np.float64]] = []
        times: list[float] = []
        began = time.perf_counter()
        while True:
            shard = _FIRST_BATCH + len(squares)
            queries = self._queries(job, shard, count)
            start = time.perf_counter()
            found = estimate_shard(
                estimator, queries, spp, target, Stream(self.seed, "test", shard), plan.allocation
            )
            times.append((time.perf_counter() - start) / count * 1e6)
            squares.append(((found.value_a.astype(np.float64) - found.value_b) ** 2 / 4.0).mean(axis=1))
            variance = mean_estimate(np.concatenate(squares)).scaled(1.0 / mean**2)
            # The 95 % interval of its root.
            narrow = NORMAL * variance.error <= 2 * HALF_WIDTH * variance.value or variance.value == 0
            late = time.perf_counter() - began > seconds
            if len(squares) >= _FEWEST_BATCHES and (narrow or late):
                # The first batch may compile kernels.
                return variance, _median(times[1:])


def _median(times: list[float]) -> Estimate:
    """Median, which other work on the machine changes little, and its standard error from the median absolute
    deviation, both as for a normal distribution."""
    middle = statistics.median(times)
    deviation = 1.4826 * statistics.median(abs(t - middle) for t in times)
    return Estimate(middle, 1.2533 * deviation / math.sqrt(len(times)), len(times))


def _relative_to(relative: Estimate, mean: Estimate) -> Estimate:
    """A number relative to a mean value, with the error of that mean."""
    return Estimate(
        relative.value, math.hypot(relative.error, relative.value * mean.relative_error), relative.n
    )


def _root(square: Estimate) -> Estimate:
    """Root of a measured square. Where the square is not significant, the error bar of first order does not
    exist; the root of the square's error bar takes its place."""
    value = math.sqrt(max(square.value, 0.0))
    if square.value <= 2.0 * square.error:
        return Estimate(value, math.sqrt(square.error), square.n)
    return Estimate(value, square.error / (2.0 * value), square.n)

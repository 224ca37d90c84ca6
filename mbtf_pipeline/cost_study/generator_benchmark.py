"""The generator's trades: error of M against seconds, split into bias and noise.

A setting is compared with a reference at the same queries. With halves a, b of the setting and
r, s of the reference, (a, r) independent of (b, s), ``E[(a - r)(b - s)]`` is the squared bias, free of the
noise of both. Within a half both use the same random numbers, so that most of the noise cancels in the
differences and small biases are seen. ``E[(a - b)²/4]`` is the variance of the setting's own noise. Both are
given as root mean squares relative to the mean value of the reference, whose own error is part of their bars.
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
from mbtf_gen.planning.sample_allocation import Allocation, measure_allocation
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.sampling.query_sampler import Queries
from mbtf_pipeline.cost_study.measurements import HALF_WIDTH, NORMAL

# Queries of one piece of the reference, and paths that it and the setting get at each.
BIAS_QUERIES = 16384
BIAS_SPP = 64
_MOST_BIAS_PIECES = 16
# Pieces of queries, and paths of each, that the mean value is taken over.
_MEAN_PIECES, _MEAN_QUERIES, _MEAN_SPP = 4, 1 << 17, 2
# Paths of one timed piece.
_PIECE_PATHS = 1 << 19
_FEWEST_PIECES = 8
# Paths per query below which pieces get no larger: closed forms take none.
_FEWEST_PATHS = 2.0
# Bias below which none is looked for.
_NEGLIGIBLE = 0.005
# Shards, of this many queries, that stand for the study's streams of random numbers.
SHARD = 1 << 14
_FIRST_MEAN = 1_001
_FIRST_REFERENCE = 5_001
_FIRST_PIECE = 10_001
# Queries that tell how many paths adaptive counts take, and the fewest of a piece.
_LOOK, _FEWEST_IN_PIECE = 2048, 1024

# Estimates queries with a stream's random numbers.
Trace = Callable[[Queries, Stream], Estimates]


@dataclass(frozen=True)
class Measurement:
    """A setting's price and error.

    Attributes
    ----------
    seconds : per million queries
    bias, noise, error : root mean squares relative to the reference's mean value; no bias where setting and
        reference trace the same
    relative : root mean square of the noise of each query over max(value, tile mean), and paths : mean per
        query, where they were asked for
    """

    seconds: Estimate
    bias: Estimate | None
    noise: Estimate
    error: Estimate
    relative: Estimate | None = None
    paths: float | None = None


@dataclass(frozen=True)
class _Reference:
    """Queries and both halves (n, 3) of the reference's values there."""

    queries: Queries
    a: NDArray[np.float64]
    b: NDArray[np.float64]


@dataclass
class GeneratorBenchmark:
    """One material and configuration, and what settings of it are compared with: at the same queries, all
    effects and no cap on interactions, but for what the reference of a study is about.

    Parameters
    ----------
    config : the recipe's generator; its level is fixed, so that every setting answers the same queries
    seed : of queries and paths
    """

    config: GeneratorConfig
    material: Material
    seed: int
    # By the reference's options: its job and estimator, and by options and number its pieces.
    _judges: dict[str, tuple[Job, Any]] = field(default_factory=dict, repr=False)
    _references: dict[tuple[str, int], _Reference] = field(default_factory=dict, repr=False)
    _means: dict[str, Estimate] = field(default_factory=dict, repr=False)

    def job(self, changes: dict[str, Any]) -> Job:
        """The job of the configuration with options changed, by dotted name."""
        data = self.config.model_dump(mode="json")
        levels = Job(self.config, self.material).lattice.finest
        fixed = {
            "queries.resolution": 1 << levels,
            "queries.layout": "shuffled",
            "output.shard_queries": SHARD,
        }
        for name, value in {**fixed, **changes}.items():
            section, _, key = name.rpartition(".")
            (data[section] if section else data)[key] = value
        return Job(GeneratorConfig.model_validate({**data, "seed": self.seed}), self.material)

    def queries(self, job: Job, shard: int, count: int) -> Queries:
        """Queries as a test split has them, one leading axis."""
        return job.query_plan.draw("test", shard, count)

    def reference(self, changes: dict[str, Any], piece: int) -> _Reference:
        """One piece of the reference with these options."""
        setting = _setting(changes)
        if (setting, piece) not in self._references:
            job, estimator = self._judge(changes)
            queries = self.queries(job, _FIRST_REFERENCE + piece, BIAS_QUERIES)
            found = estimator.estimate(queries, BIAS_SPP, self._stream(piece))
            a, b = found.value_a.astype(np.float64), found.value_b.astype(np.float64)
            self._references[setting, piece] = _Reference(queries, a, b)
        return self._references[setting, piece]

    def mean(self, changes: dict[str, Any]) -> Estimate:
        """Mean value of the reference with these options, 1/sr, which errors are relative to: of many more
        queries than have the paths that a bias takes."""
        setting = _setting(changes)
        if setting not in self._means:
            job, estimator = self._judge(changes)
            parts = []
            # A piece spans several shards.
            for number in range(_MEAN_PIECES):
                shard = _FIRST_MEAN + number * (_MEAN_QUERIES // SHARD)
                queries = self.queries(job, shard, _MEAN_QUERIES)
                found = estimator.estimate(queries, _MEAN_SPP, Stream(self.seed, "test", shard))
                parts.append(0.5 * (found.value_a.astype(np.float64) + found.value_b).mean(axis=1))
            self._means[setting] = mean_estimate(np.concatenate(parts))
        return self._means[setting]

    def _judge(self, changes: dict[str, Any]) -> tuple[Job, Any]:
        setting = _setting(changes)
        if setting not in self._judges:
            job = self.job({"effects.mode": "all", "transport.max_depth": 0, **changes})
            self._judges[setting] = job, build_estimator(job, plan_effects(job))
        return self._judges[setting]

    def _stream(self, piece: int) -> Stream:
        return Stream(self.seed, "test", _FIRST_REFERENCE + piece)

    def measure(self, changes: dict[str, Any], against: dict[str, Any] | None, seconds: float) -> Measurement:
        """Price and error of a setting.

        Parameters
        ----------
        changes : options of the setting; against : options of the reference, or None where the setting only
            takes another number of paths, which leaves no bias
        seconds : spent on each of timing and bias at most; less where the error bars are small before
        """
        job = self.job(changes)
        estimator = build_estimator(job, plan_effects(job))
        mean = self.mean(against or {})
        spp = split_spp(job.config, "train")

        def trace(queries: Queries, stream: Stream) -> Estimates:
            found: Estimates = estimator.estimate(queries, spp, stream)
            return found

        noise, price = self._noise(job, trace, spp, seconds, mean.value)
        root = _beside(_root(noise), mean)
        if against is None:
            return Measurement(price, None, root, root)
        bias = self.bias(estimator, against, seconds)
        total = _beside(_root(_total(bias, noise)), mean)
        return Measurement(price, _beside(_root(bias), mean), root, total)

    def measure_counts(self, changes: dict[str, Any], adaptive: bool, seconds: float) -> Measurement:
        """Price and noise where queries get the same number of paths, or each its own: `adaptive` with the
        run's allocation, whose pilot is not timed, as it is once for a whole data set.

        Parameters
        ----------
        seconds : spent on each of both measures of the noise at most
        """
        job = self.job(changes)
        plan = plan_effects(job)
        estimator = build_estimator(job, plan)
        allocation = measure_allocation(job, plan)
        chosen = allocation if adaptive and not plan.closed_form else None
        target, spp = split_target(job.config, "train"), split_spp(job.config, "train")

        def trace(queries: Queries, stream: Stream) -> Estimates:
            return estimate_shard(estimator, queries, spp, target, stream, chosen)

        first, mean = self.reference({}, 0), self.mean({})
        look = trace(first.queries.take(slice(_LOOK)), Stream(self.seed, "test", _FIRST_PIECE))
        paths = max(look.paths, 1) / len(look.value_a)
        noise, price = self._noise(job, trace, paths, seconds, mean.value)
        root = _beside(_root(noise), mean)
        relative = self._relative(trace, paths, seconds, allocation)
        return Measurement(price, None, root, root, _root(relative), paths)

    def _relative(self, trace: Trace, paths: float, seconds: float, allocation: Allocation) -> Estimate:
        """Variance of one query's noise over the square of max(value, tile mean); values are those of the
        reference, which no path of the setting enters."""
        count = int(min(max(_PIECE_PATHS / paths, _FEWEST_IN_PIECE), BIAS_QUERIES))
        squares: list[NDArray[np.float64]] = []
        began = time.perf_counter()
        while True:
            piece = len(squares)
            reference = self.reference({}, piece)
            queries = reference.queries.take(slice(count))
            found = trace(queries, Stream(self.seed, "test", _FIRST_PIECE + piece))
            value = 0.5 * (reference.a + reference.b)[:count].mean(axis=1)
            scale = np.maximum(value, allocation.tile_mean(queries))
            square = ((found.value_a.astype(np.float64) - found.value_b) ** 2 / 4.0).mean(axis=1)
            squares.append(np.divide(square, scale**2, out=np.zeros(len(square)), where=scale > 0))
            variance = mean_estimate(np.concatenate(squares))
            late = time.perf_counter() - began > seconds or len(squares) == _MOST_BIAS_PIECES
            if _sure(variance) or late:
                return variance

    def bias(self, estimator: Any, against: dict[str, Any], seconds: float, spp: int = BIAS_SPP) -> Estimate:
        """Squared bias relative to the mean value squared.

        Parameters
        ----------
        against : options of the reference
        spp : paths of the estimator at each query; the bias does not depend on them, its error bar does
        """
        mean = self.mean(against).value
        began = time.perf_counter()
        squares: list[NDArray[np.float64]] = []
        while True:
            piece = len(squares)
            reference = self.reference(against, piece)
            found = estimator.estimate(reference.queries, spp, self._stream(piece))
            a, b = found.value_a.astype(np.float64), found.value_b.astype(np.float64)
            squares.append(((a - reference.a) * (b - reference.b)).mean(axis=1) / mean**2)
            square = mean_estimate(np.concatenate(squares))
            sure = NORMAL * square.error <= max(2 * HALF_WIDTH * square.value, _NEGLIGIBLE**2)
            late = time.perf_counter() - began > seconds or len(squares) == _MOST_BIAS_PIECES
            if sure or late:
                return square

    def _noise(
        self, job: Job, trace: Trace, paths: float, seconds: float, mean: float
    ) -> tuple[Estimate, Estimate]:
        """Variance of one query's noise relative to the mean value squared, and seconds per million
        queries of about so many paths; the first piece, which may compile, is not timed."""
        count = max(1, round(_PIECE_PATHS / max(paths, _FEWEST_PATHS)))
        squares: list[NDArray[np.float64]] = []
        prices: list[float] = []
        began = time.perf_counter()
        piece = 0
        while True:
            queries = self.queries(job, _FIRST_PIECE + piece, count)
            start = time.perf_counter()
            found = trace(queries, Stream(self.seed, "test", _FIRST_PIECE + piece))
            took = time.perf_counter() - start
            difference = found.value_a.astype(np.float64) - found.value_b
            squares.append((difference**2 / 4.0).mean(axis=1) / mean**2)
            if piece:
                prices.append(took / len(difference) * 1e6)
            piece += 1
            variance = mean_estimate(np.concatenate(squares))
            if piece >= _FEWEST_PIECES and (_sure(variance) or time.perf_counter() - began > seconds):
                return variance, _typical(prices)


def _setting(changes: dict[str, Any]) -> str:
    """Options as a key, whatever their order."""
    return repr(sorted(changes.items()))


def _typical(prices: list[float]) -> Estimate:
    """Median, which other work on the machine moves little, and its standard error from the median absolute
    deviation, both as for normal scatter."""
    middle = statistics.median(prices)
    deviation = 1.4826 * statistics.median(abs(p - middle) for p in prices)
    return Estimate(middle, 1.2533 * deviation / math.sqrt(len(prices)), len(prices))


def _sure(variance: Estimate) -> bool:
    """Whether the 95 % interval of a variance's root is as narrow as wanted."""
    return NORMAL * variance.error <= 2 * HALF_WIDTH * variance.value or variance.value == 0


def _total(bias: Estimate, noise: Estimate) -> Estimate:
    """Mean squared error from its parts; a squared bias that noise made negative counts as none."""
    return Estimate(max(bias.value, 0.0) + noise.value, math.hypot(bias.error, noise.error), noise.n)


def _beside(relative: Estimate, mean: Estimate) -> Estimate:
    """With the error of the mean value that it is relative to."""
    error = math.hypot(relative.error, relative.value * mean.relative_error)
    return Estimate(relative.value, error, relative.n)


def _root(square: Estimate) -> Estimate:
    """Root of a measured square. Where the square is not told from zero its root has no error bar of first
    order: the bar is then the root of the square's own bar."""
    value = math.sqrt(max(square.value, 0.0))
    if square.value <= 2.0 * square.error:
        return Estimate(value, math.sqrt(square.error), square.n)
    return Estimate(value, square.error / (2.0 * value), square.n)

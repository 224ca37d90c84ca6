"""The generator's trades: error of M against seconds, split into bias and noise.

A setting is compared with a converged reference at the same queries. With halves a, b of the setting and
r, s of the reference, (a, r) independent of (b, s), ``E[(a - r)(b - s)]`` is the squared bias, free of the
noise of both. Within a half both use the same random numbers, so that most of the noise cancels in the
differences and small biases are seen. ``E[(a - b)²/4]`` is the variance of the setting's own noise. Both are
given as root mean squares relative to the mean value of the reference.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.config import GeneratorConfig
from mbtf_gen.estimates import Stream
from mbtf_gen.generation import Job
from mbtf_gen.material import Material
from mbtf_gen.planning import plan_effects
from mbtf_gen.queries import Queries
from mbtf_gen.stats import Estimate, mean_estimate

# Queries at which a bias is measured, and paths that the reference and the setting get at each.
BIAS_QUERIES = 4096
BIAS_SPP = 512
# Paths of one timed piece, and the half-width of a 95 % interval at which timing stops.
_PIECE_PATHS = 1 << 19
_HALF_WIDTH = 0.1
_FEWEST_PIECES = 4
# Shards that stand for the study's streams of random numbers: no data set has so many.
_REFERENCE_SHARD = 900_001
_FRESH_SHARD = 900_002
_FIRST_PIECE = 900_003


@dataclass(frozen=True)
class Measured:
    """A setting's price and error.

    Attributes
    ----------
    seconds : per million queries
    bias, noise, error : root mean squares relative to the reference's mean value
    """

    seconds: Estimate
    bias: Estimate
    noise: Estimate
    error: Estimate


@dataclass
class Bench:
    """One material and configuration, and what settings of it are compared with.

    Parameters
    ----------
    config : the recipe's generator; its level is fixed, so that every setting answers the same queries
    seed : of queries and paths
    """

    config: GeneratorConfig
    material: Material
    seed: int
    _references: dict[str, Any] = field(default_factory=dict, repr=False)

    def job(self, changes: dict[str, Any]) -> Job:
        """The job of the configuration with options changed, by dotted name."""
        data = self.config.model_dump(mode="json")
        levels = Job.of(self.config, self.material).lattice.finest
        fixed = {"queries.levels": levels, "queries.layout": "shuffled"}
        for name, value in {**fixed, **changes}.items():
            section, _, key = name.rpartition(".")
            (data[section] if section else data)[key] = value
        return Job.of(GeneratorConfig.model_validate({**data, "seed": self.seed}), self.material)

    def queries(self, job: Job, shard: int, count: int) -> Queries:
        """Queries as a test split has them, one leading axis."""
        return job.plan().draw("test", shard, count)

    def reference(
        self, changes: dict[str, Any]
    ) -> tuple[Queries, NDArray[np.float64], NDArray[np.float64], float]:
        """(queries, both halves, mean value) of the converged reference with these options."""
        key = repr(sorted(changes.items()))
        if key not in self._references:
            job = self.job({"effects.mode": "all", "transport.max_depth": 0, **changes})
            queries = self.queries(job, _REFERENCE_SHARD, BIAS_QUERIES)
            found = job.estimator(plan_effects(job)).estimate(
                queries, BIAS_SPP, Stream(self.seed, "test", _REFERENCE_SHARD)
            )
            a, b = found.value_a.astype(np.float64), found.value_b.astype(np.float64)
            self._references[key] = (queries, a, b, float((a + b).mean() / 2))
        out: tuple[Queries, NDArray[np.float64], NDArray[np.float64], float] = self._references[key]
        return out

    def measure(
        self, changes: dict[str, Any], against: dict[str, Any], seconds: float, *, fresh: bool = False
    ) -> Measured:
        """Price and error of a setting.

        Parameters
        ----------
        changes : options of the setting; against : options of the reference
        seconds : spent on timing at most; less where the error bars are small before
        fresh : random numbers and number of paths of the setting's own; where setting and reference trace the
            same, with the same numbers their difference would be zero by construction
        """
        queries, r, s, mean = self.reference(against)
        job = self.job(changes)
        estimator = job.estimator(plan_effects(job))
        spp = job.config.queries.spp
        shard, paths = (_FRESH_SHARD, spp) if fresh else (_REFERENCE_SHARD, BIAS_SPP)
        found = estimator.estimate(queries, paths, Stream(self.seed, "test", shard))
        a, b = found.value_a.astype(np.float64), found.value_b.astype(np.float64)
        bias = mean_estimate((a - r) * (b - s) / mean**2)
        noise, price = self._noise(job, estimator, spp, seconds, mean)
        return Measured(price, _root(bias), _root(noise), _root(_total(bias, noise)))

    def _noise(
        self, job: Job, estimator: Any, spp: int, seconds: float, mean: float
    ) -> tuple[Estimate, Estimate]:
        """Variance of one query's noise relative to the mean value squared, and seconds per million
        queries; the first piece, which may compile, is not timed."""
        count = max(1, _PIECE_PATHS // spp)
        squares: list[NDArray[np.float64]] = []
        prices: list[float] = []
        began = time.perf_counter()
        piece = 0
        while True:
            queries = self.queries(job, _FIRST_PIECE + piece, count)
            start = time.perf_counter()
            found = estimator.estimate(queries, spp, Stream(self.seed, "test", _FIRST_PIECE + piece))
            took = time.perf_counter() - start
            difference = found.value_a.astype(np.float64) - found.value_b
            squares.append((difference**2 / 4.0).mean(axis=1) / mean**2)
            if piece:
                prices.append(took / len(difference) * 1e6)
            piece += 1
            variance = mean_estimate(np.concatenate(squares))
            sure = 1.96 * variance.error <= 2 * _HALF_WIDTH * variance.value or variance.value == 0
            if piece >= _FEWEST_PIECES and (sure or time.perf_counter() - began > seconds):
                return variance, mean_estimate(prices)


def _total(bias: Estimate, noise: Estimate) -> Estimate:
    """Mean squared error from its parts; a squared bias that noise made negative counts as none."""
    return Estimate(max(bias.value, 0.0) + noise.value, math.hypot(bias.error, noise.error), noise.n)


def _root(square: Estimate) -> Estimate:
    """Root of a measured square. Where the square is not told from zero its root has no error bar of first
    order: the bar is then the root of the square's own bar."""
    value = math.sqrt(max(square.value, 0.0))
    if square.value <= 2.0 * square.error:
        return Estimate(value, math.sqrt(square.error), square.n)
    return Estimate(value, square.error / (2.0 * value), square.n)

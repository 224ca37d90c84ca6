"""The test queries that whole chains are judged by: more of them where values are bright.

Squared errors, and the variance that they are divided by, are ruled by few queries: under a light of 1° a
glossy relief answers one fine footprint in ten thousand with a hundred times the mean value. Half a million
queries alike then leave bars of 10 % and more. So many more candidates are drawn as a test split has them,
each is looked at with a few paths, and queries are taken from them with a probability of which a quarter is
alike, and the rest in proportion to the square of what was seen and to the mean square of candidates of like
footprint and directions, half by half: a fit misses, too, where one is dark among bright ones. Weights of one
over that probability undo the choice without bias, whatever was seen; the paths that were looked at are not
used again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbtf_core.lattice import level_of_sigma
from mbtf_core.stats import Estimate, unexplained_variance
from mbtf_fit.data.loader import Queries as FitQueries
from mbtf_gen.planning.effects_plan import plan_effects
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Stream
from mbtf_gen.sampling.query_sampler import Queries
from mbtf_gen.sampling.rng import Purpose, numpy_generator
from mbtf_pipeline.cost_study.generator_benchmark import SHARD, GeneratorBenchmark

# Shards that stand for the streams of candidates; the paths of those taken come so many shards later.
_FIRST_CANDIDATES, _PASS_ON = 20_001, 10_000
# Candidates of one piece, and paths that each is looked at with.
_PIECE = 1 << 18
_LOOK = 4
# Cells of alike queries: levels, and parts of the cosines of light and view and of the half vector's sine.
_LEVELS, _ANGLES = 16, (6, 6, 8)
# Paths of a query that is taken; the fewest of all, and the most queries and candidates: what is made in
# seconds.
_SPP = 32
_FEWEST_PATHS = 1 << 14
_MOST, _MOST_CANDIDATES = 1 << 19, 1 << 23
# Probability that does not depend on what was seen, as a share of the mean one.
_ALIKE = 0.25


@dataclass(frozen=True)
class Judges:
    """Test queries, and for how many each stands.

    Attributes
    ----------
    queries : n queries with both halves of their values
    weights : (n,) one over the probability with which each was taken
    """

    queries: FitQueries
    weights: NDArray[np.float64]

    def unexplained(self, prediction: NDArray[np.float32]) -> Estimate:
        """Unexplained variance of values (n, 3), over queries as a test split has them."""
        return unexplained_variance(prediction, self.queries.value_a, self.queries.value_b, self.weights)


def draw_judges(bench: GeneratorBenchmark, paths: int) -> Judges:
    """Judges of a bench's material and configuration.

    Parameters
    ----------
    paths : of all that are taken, 32 each; twice as many candidates are looked at. At least 16 384; at most
        524 288 queries are taken, of 8 million candidates. Halves need no more, for errors are free of
        noise; what limits them is how they vary over queries
    """
    job = bench.job({})
    paths = max(paths, _FEWEST_PATHS)
    count = min(paths // _SPP, _MOST)
    candidates = min(2 * paths, _MOST_CANDIDATES)
    estimator = build_estimator(job, plan_effects(job, pilots=False))
    sizes = [min(_PIECE, candidates - start) for start in range(0, candidates, _PIECE)]
    # A piece spans several of the bench's shards.
    shards = [_FIRST_CANDIDATES + start // SHARD for start in range(0, candidates, _PIECE)]
    seen, cells = [], []
    for shard, size in zip(shards, sizes, strict=True):
        drawn = bench.queries(job, shard, size)
        found = estimator.estimate(drawn, _LOOK, Stream(bench.seed, "test", shard))
        values = 0.5 * (found.value_a.astype(np.float64) + found.value_b)
        seen.append((values**2).mean(axis=1))
        cells.append(_cells(drawn))
    squares = _half_local(np.concatenate(seen), np.concatenate(cells))
    chances = np.split(_chances(squares, count), np.cumsum(sizes)[:-1])
    parts, weights = [], []
    for shard, size, chance in zip(shards, sizes, chances, strict=True):
        choice = numpy_generator(bench.seed, "test", shard, Purpose.CHOICE)
        rows = np.flatnonzero(choice.random(size) < chance)
        if len(rows) == 0:
            continue
        drawn = bench.queries(job, shard, size)
        taken = drawn.take(rows)
        found = estimator.estimate(taken, _SPP, Stream(bench.seed, "test", _PASS_ON + shard))
        halves = found.value_a, found.value_b
        parts.append(FitQueries(taken.u, taken.sigma, taken.omega_i, taken.omega_o, *halves))
        weights.append(1.0 / chance[rows])
    return Judges(FitQueries.join(parts), np.concatenate(weights))


def _cells(queries: Queries) -> NDArray[np.int64]:
    """Number (n,) of the cell of footprint, light, view and half vector that each query lies in."""
    half = queries.omega_i + queries.omega_o
    tilt = half[:, 2] / np.linalg.norm(half, axis=1)
    cosines = (queries.omega_i[:, 2], queries.omega_o[:, 2], np.sqrt(1.0 - np.minimum(tilt**2, 1.0)))
    out = np.clip(level_of_sigma(queries.sigma), 0, _LEVELS - 1).astype(np.int64)
    for value, n in zip(cosines, _ANGLES, strict=True):
        out = out * n + np.clip(value * n, 0, n - 1).astype(np.int64)
    return out


def _half_local(squares: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """Squares (n,), half of each replaced by the mean of its cell: a fit misses, too, where a query is dark
    by chance among bright ones."""
    counts = np.bincount(cells)
    means = np.bincount(cells, squares) / np.maximum(counts, 1)
    out: NDArray[np.float64] = 0.5 * (squares + means[cells])
    return out


def _chances(squares: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Probability (n,) of each candidate to be taken, `count` in all, from the squares of what was seen of
    it. What the certain ones leave over goes to the others in proportion to theirs: one firefly must not use
    up the share of all that are bright."""
    n = len(squares)
    alike = min(1.0, _ALIKE * count / n)
    certain = np.zeros(n, bool)
    while True:
        total = squares[~certain].sum()
        left = count - certain.sum() - alike * (n - certain.sum())
        scale = left / total if total > 0 else 0.0
        chances = np.where(certain, 1.0, alike + scale * squares)
        if total <= 0:
            # All is black, or as good as: all alike.
            chances = np.where(certain, 1.0, (count - certain.sum()) / max(1, n - certain.sum()))
        more = chances > 1.0
        if not more.any():
            return chances
        certain |= more

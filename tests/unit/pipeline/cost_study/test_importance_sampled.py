"""The test queries that chains are judged by stand for all, with honest bars."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from support.fake_benchmark import FakeEstimator, fake_benchmark

from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.sampling.query_sampler import Queries
from mbtf_pipeline.cost_study.generator_benchmark import GeneratorBenchmark
from mbtf_pipeline.cost_study.importance_sampled import _chances, draw_judges

BRIGHT, GLOW = 0.001, 30.0


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> GeneratorBenchmark:
    return fake_benchmark(monkeypatch)


@pytest.fixture
def lit(bench: GeneratorBenchmark, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int, int]]:
    """One query in a thousand is thirty times as bright; what was traced: paths, shard, queries."""
    traced: list[tuple[int, int, int]] = []

    def estimate(self: FakeEstimator, queries: Queries, spp: int, stream: Stream) -> Estimates:
        assert stream.split == "test"
        traced.append((spp, stream.shard, len(queries.sigma)))
        rng = np.random.default_rng([stream.root, stream.shard])
        truth = np.where(queries.u[:, :1] < BRIGHT, GLOW, 1.0)
        halves = [(truth * rng.gamma(spp, 1 / spp, (len(truth), 3))).astype(np.float32) for _ in range(2)]
        return Estimates(*halves, None, spp * len(truth), 0, 0, 0)

    monkeypatch.setattr(FakeEstimator, "estimate", estimate)
    monkeypatch.setattr("mbtf_pipeline.cost_study.importance_sampled.plan_effects", lambda job, pilots: None)
    monkeypatch.setattr("mbtf_pipeline.cost_study.importance_sampled._PIECE", 1 << 15)
    return traced


def test_judges_stand_for_all_queries(bench: GeneratorBenchmark, lit: list[tuple[int, int, int]]) -> None:
    """The bright ones are among the judges, and weigh little."""
    judges = draw_judges(bench, 200_000)
    q, w = judges.queries, judges.weights
    candidates, taken = 400_000, 200_000 // 32
    assert abs(len(q) / taken - 1) < 4 / math.sqrt(taken)
    assert abs(w.sum() / candidates - 1) < 4 / math.sqrt(taken)
    # Pieces follow each other without overlap, and what was looked at is not what is judged by.
    assert len(np.unique(q.u, axis=0)) == len(q)
    looked, judged = ([shard for spp, shard, _ in lit if spp == n] for n in (4, 32))
    assert looked == [20_001 + 2 * k for k in range(-(-candidates // (1 << 15)))]
    assert min(judged) > max(looked)
    assert len(set(judged)) == len(judged) == len(looked)
    # All bright ones are there, and none of them stands for many.
    hit = q.u[:, 0] < BRIGHT
    assert abs(hit.sum() / (BRIGHT * candidates) - 1) < 4 / math.sqrt(BRIGHT * candidates)
    assert w[hit].max() < 2

    # Which are taken has nothing to do with their footprint.
    def level(sigma: Any) -> Any:
        return -np.log2(2 * sigma)

    everyone = level(bench.queries(bench.job({}), 90_001, 100_000).sigma)
    mean = np.average(level(q.sigma), weights=w)
    assert abs(mean - everyone.mean()) < 4 * everyone.std() * math.sqrt((w**2).sum()) / w.sum()


def test_judges_have_honest_bars(bench: GeneratorBenchmark, lit: list[tuple[int, int, int]]) -> None:
    """Fits that miss all of the bright ones, or half of everything, judged with many seeds."""
    variance = BRIGHT * (1 - BRIGHT) * (GLOW - 1) ** 2
    square = 1 + BRIGHT * (GLOW**2 - 1)
    truths = (BRIGHT * (GLOW - 1) ** 2 / variance, 0.25 * square / variance)
    pulls: list[list[float]] = [[], []]
    for seed in range(60):
        judges = draw_judges(GeneratorBenchmark(bench.config, bench.material, seed), 60_000)
        value = np.where(judges.queries.u[:, :1] < BRIGHT, GLOW, 1.0).astype(np.float32)
        flat = np.ones((len(value), 3), np.float32)
        for found, prediction, truth in zip(pulls, (flat, 0.5 * value * flat), truths, strict=True):
            estimate = judges.unexplained(prediction)
            found.append((estimate.value - truth) / estimate.error)
            assert estimate.error < 0.2 * truth
    for found in pulls:
        assert abs(np.mean(found)) < 4 / math.sqrt(len(found))
        assert 0.7 < np.std(found) < 1.35


def test_the_smallest_test_split_has_judges(
    bench: GeneratorBenchmark, lit: list[tuple[int, int, int]]
) -> None:
    assert len(draw_judges(bench, 2).queries) > 300


def test_judges_are_all_alike_where_all_is_black() -> None:
    assert np.allclose(_chances(np.zeros(1000), 100), 0.1)
    # One firefly does not use up the share of all that are bright.
    chances = _chances(np.array([1e9, *np.full(100, 10.0), *np.ones(899)]), 100)
    assert chances.sum() == pytest.approx(100)
    assert chances[0] == 1.0
    assert chances[1] > 0.25
    assert chances[-1] > 0.05

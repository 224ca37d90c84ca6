"""Runs to a target error: unbiased values, independent halves, and the requested error."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from support.small_runs import contents

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import Queries
from mbtf_core.stats import mean_estimate, noise_free_mse, t_test
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.generation.manifest import finish
from mbtf_gen.generation.run import generate
from mbtf_gen.planning.adaptive import estimate_shard
from mbtf_gen.planning.job import Job, split_spp, split_target
from mbtf_gen.planning.run_plan import plan_effects, plan_run
from mbtf_gen.planning.sample_allocation import Allocation, fit_allocation
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream, Target
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan

load_mitsuba()

from mbtf_gen.render.estimator import MAX_RESAMPLES  # noqa: E402

N = 20_000
RARE, BRIGHT, DIM = 0.04, 4.0, 0.05
TRUTH = RARE * BRIGHT + (1 - RARE) * DIM


class FewBrightPaths:
    """Replaces an estimator: most paths carry little light, one in twenty-five much."""

    def paths(self, n: int, spp: int, stream: Stream) -> NDArray[np.float64]:
        seed = [stream.root, stream.shard, stream.first_pass, spp]
        return np.where(np.random.default_rng(seed).random((n, spp)) < RARE, BRIGHT, DIM)

    def estimate(self, queries: Queries, spp: Any, stream: Stream, **options: Any) -> Estimates:
        n = len(queries.sigma)
        counts = np.broadcast_to(np.asarray(spp), (n,))
        value, variance = np.zeros((2, n, 3), np.float32), np.zeros(n, np.float32)
        for count in np.unique(counts):
            rows = np.flatnonzero(counts == count)
            y = self.paths(len(rows), int(count), stream)
            value[:, rows] = np.stack([h.mean(axis=1) for h in np.split(y, 2, axis=1)])[..., None]
            variance[rows] = y.var(axis=1, ddof=1)
        every = None if isinstance(spp, int) else counts
        return Estimates(
            value[0], value[1], None, int(counts.sum()), 0, 0, 0, spp=every, path_variance=variance
        )


@pytest.fixture(scope="module")
def skewed() -> tuple[Queries, Allocation]:
    q = QueryPlan(Lattice(4), LevelMixture(0.6, 0.4), 0.1, "shuffled", 0, N).draw("train", 0, N)
    pilot = FewBrightPaths().estimate(q, 16, Stream(0, "pilot", 1))
    return q, fit_allocation(q, pilot, 16, 4)


def test_values_of_a_skewed_scene_are_unbiased(skewed: tuple[Queries, Allocation]) -> None:
    q, allocation = skewed
    e = estimate_shard(FewBrightPaths(), q, 4, Target(0.2, 512), Stream(1, "train", 0), allocation)
    assert len(np.unique(e.spp)) > 3
    a, b = e.value_a[:, 0].astype(np.float64), e.value_b[:, 0].astype(np.float64)
    assert t_test(mean_estimate(0.5 * (a + b)), TRUTH).p_value > 1e-3
    # Within every count as well, and the halves' errors do not go together.
    for count in np.unique(e.spp):
        some = e.spp == count
        if some.sum() >= 1000:
            assert t_test(mean_estimate(0.5 * (a + b)[some]), TRUTH).p_value > 1e-4
    assert t_test(mean_estimate((a - TRUTH) * (b - TRUTH))).p_value > 1e-3


def test_the_pilot_draws_random_numbers_of_its_own(skewed: tuple[Queries, Allocation]) -> None:
    """Values are biased if the paths that choose a query's number of paths are also stored."""
    streams = []

    class Recording(FewBrightPaths):
        def estimate(self, queries: Queries, spp: Any, stream: Stream, **options: Any) -> Estimates:
            streams.append(stream)
            return super().estimate(queries, spp, stream, **options)

    q, allocation = skewed
    stream = Stream(1, "train", 0)
    estimate_shard(Recording(), q.take(slice(100)), 4, Target(0.2, 64), stream, allocation)
    pilot, stored = streams
    assert stored == stream
    # Samples that are not finite are drawn again in the passes that follow.
    assert abs(pilot.first_pass - stored.first_pass) > MAX_RESAMPLES


def test_a_group_has_the_paths_of_its_noisiest_query(skewed: tuple[Queries, Allocation]) -> None:
    q, allocation = skewed
    some, stream = q.take(slice(400)), Stream(1, "train", 0)
    alone, shared = (
        estimate_shard(FewBrightPaths(), some, 4, Target(0.2, 512), stream, allocation, n) for n in (1, 4)
    )
    expected = alone.spp.reshape(4, -1).max(axis=0)
    assert (shared.spp.reshape(4, -1) == expected).all()
    assert expected.min() < expected.max()


@pytest.mark.parametrize(("most", "low", "high"), [(8192, 0.2, 0.24), (8, 1.0, 9.0)])
def test_a_skewed_scene_comes_near_its_target_and_what_is_reported_is_so(
    most: int, low: float, high: float, skewed: tuple[Queries, Allocation]
) -> None:
    """Also what a cap leaves, although rare bright paths increase the value itself."""
    q, allocation = skewed
    e = estimate_shard(FewBrightPaths(), q, 4, Target(0.2, most), Stream(1, "train", 0), allocation)
    value = 0.5 * (e.value_a[:, 0].astype(np.float64) + e.value_b[:, 0])
    error = float(np.sqrt(np.mean((value - TRUTH) ** 2))) / TRUTH
    assert low < error < high
    assert np.sqrt(e.target.square) == pytest.approx(error, rel=0.2)
    # What the pilot expects of a path is its root mean square deviation.
    s = allocation.deviation(q)
    assert np.sqrt(np.mean(s**2)) == pytest.approx(np.sqrt(RARE * (1 - RARE)) * (BRIGHT - DIM), rel=0.05)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> GeneratorConfig:
    folder = tmp_path_factory.mktemp("maps")
    rng = np.random.default_rng(4)
    np.save(folder / "height.npy", np.kron(rng.random((8, 8)), np.ones((2, 2))))
    queries = {"train": "1500", "test": "8", "test_spp": 4, "target_error": "6%", "max_spp": 256}
    rest = {"geometry": {"height_scale": 0.05}, "queries": queries, "output": {"shard_queries": 500}}
    return GeneratorConfig.model_validate({"material": str(folder / "height.npy"), **rest})


def test_the_error_reached_is_the_target(config: GeneratorConfig, tmp_path: Path) -> None:
    found = generate(config, tmp_path / "out")
    data = Dataset.open(tmp_path / "out").load("train")
    a, b, spp = data["value_a"], data["value_b"], data["spp"]
    # Counts are rounded up and low-discrepancy points do better than the pilot's single paths say.
    assert 0.03 < found.target["reached"] < 0.06
    assert spp.max() <= 256
    assert len(np.unique(spp)) > 4
    assert found.target["missed"] <= (spp == 256).sum()
    # Against a run of many paths: the squared error that the halves do not know of.
    fixed = config.model_dump()
    fixed["queries"] |= {"target_error": None, "spp": 512}
    generate(GeneratorConfig.model_validate(fixed), tmp_path / "many")
    many = Dataset.open(tmp_path / "many").load("train")
    np.testing.assert_array_equal(many["u"], data["u"])
    mean = float(a.mean())
    scale = np.maximum(0.5 * (many["value_a"] + many["value_b"]).mean(axis=1, keepdims=True), mean)
    squared = noise_free_mse(0.5 * (a + b) / scale, many["value_a"] / scale, many["value_b"] / scale)
    assert np.sqrt(squared.value) == pytest.approx(found.target["reached"], rel=0.15)
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["summary"]["target"] == found.target
    assert manifest["allocation"]["typical"] > 0


def of_kind(config: GeneratorConfig, kind: str) -> GeneratorConfig:
    """Eight shards, with a target error or a mean number of paths."""
    data = config.model_dump()
    data["output"]["shard_queries"] = 220
    if kind == "noise":
        data["queries"] |= {"target_error": None, "spp": 8}
    return GeneratorConfig.model_validate(data)


@pytest.fixture
def small_pilots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of any size use a pilot, and pilots are short."""
    for name in ("SMALL_RUN", "SMALLEST_ALLOCATED"):
        monkeypatch.setattr(f"mbtf_gen.planning.run_plan.{name}", 0)
    monkeypatch.setattr("mbtf_gen.planning.sample_allocation.PILOT_QUERIES", 1024)
    monkeypatch.setattr("mbtf_gen.planning.run_plan.plan_effects", lambda job, pilots: plan_effects(job))


@pytest.mark.parametrize("kind", ["target", "noise"])
def test_slices_equal_a_run(kind: str, config: GeneratorConfig, small_pilots: None, tmp_path: Path) -> None:
    """Seven slices in any order give the same numbers of paths and the same values."""
    config = of_kind(config, kind)
    for index in (4, 2, 7, 1, 6, 3, 5):
        generate(config, tmp_path / "parts", slice_index=index, slice_count=7)
    assert finish(tmp_path / "parts").complete
    generate(config, tmp_path / "whole")
    parts, whole = (contents(tmp_path / name) for name in ("parts", "whole"))
    assert parts == whole
    assert whole["manifest.json"]["allocation"] is not None
    assert len([name for name in whole if name.endswith(".npz")]) == 8
    assert len(np.unique(Dataset.open(tmp_path / "whole").load("train")["spp"])) > 3


@pytest.mark.parametrize("kind", ["target", "noise"])
def test_counts_ignore_launches_and_threads(kind: str, config: GeneratorConfig, small_pilots: None) -> None:
    job = Job.load(of_kind(config, kind))
    plan = plan_run(job)
    n = 600
    q = job.query_plan.draw("train", 1, n)
    estimator = build_estimator(job, plan.effects)
    before, found = dr.thread_count(), []
    try:
        for launch, threads in ((1 << 20, 3), (1 << 9, 1), (777, 3)):
            dr.set_thread_count(threads)
            estimator.launch = launch
            stream = Stream(job.config.seed, "train", 1)
            options = split_spp(job.config, "train"), split_target(job.config, "train"), stream
            found.append(estimate_shard(estimator, q, *options, plan.allocation))
    finally:
        dr.set_thread_count(before)
    one = found[0]
    assert len(np.unique(one.spp)) > 3
    for other in found[1:]:
        assert (other.spp == one.spp).all()
        assert (other.value_a == one.value_a).all()
        assert (other.value_b == one.value_b).all()
        assert other.target == one.target

"""Cost studies of the generator: seconds, bias and noise are found where they are known."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.fake_benchmark import NOISE, SHIFT, FakeEstimator, fake_benchmark

from mbtf_core.errors import InputError
from mbtf_core.stats import Estimate
from mbtf_gen.planning.effects_plan import plan_effects
from mbtf_pipeline.cost_study.generator_benchmark import GeneratorBenchmark
from mbtf_pipeline.cost_study.generator_runs import COUNTS, TARGETS, generator_tasks


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> GeneratorBenchmark:
    return fake_benchmark(monkeypatch)


@pytest.mark.parametrize("spp", [4, 64])
def test_bias_and_noise_are_told_apart(bench: GeneratorBenchmark, spp: int) -> None:
    found = bench.measure({"transport.max_depth": 1, "queries.spp": spp}, {}, 0.0)
    # Relative to the mean value 0.25: the bias is the shift times the values, the noise that of spp paths.
    bias = SHIFT * math.sqrt(np.mean((0.2 + 0.1 * np.linspace(0, 1, 10001)) ** 2)) / 0.25
    noise = NOISE / math.sqrt(spp)
    assert found.bias is not None
    for estimate, truth in ((found.bias, bias), (found.noise, noise), (found.error, math.hypot(bias, noise))):
        assert abs(estimate.value - truth) < 4 * estimate.error
        assert estimate.error < 0.05 * truth
    assert found.seconds.value > 0


def test_an_unbiased_setting_shows_no_bias(bench: GeneratorBenchmark) -> None:
    found = bench.measure({"transport.max_depth": 3}, {}, 0.0)
    assert found.bias is not None
    assert found.bias.value == 0.0
    assert bench.measure({"queries.spp": 8}, None, 0.0).bias is None


def test_adaptive_counts_are_measured_by_both_kinds_of_error(
    bench: GeneratorBenchmark, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Values of known noise, the same for all: a target error takes the paths that bring it."""
    monkeypatch.setattr(
        "mbtf_pipeline.cost_study.generator_benchmark.plan_effects",
        lambda job: plan_effects(job, pilots=False),
    )
    even = bench.measure_counts({"queries.spp": 16, "queries.allocation": "uniform"}, False, 0.0)
    assert even.bias is None
    assert even.paths == 16
    assert abs(even.noise.value - NOISE / 4) < 4 * even.noise.error
    assert even.relative is not None
    # Deviation 0.2 of one path over values of 0.2 to 0.3, or over their mean 0.25 where that is more.
    scale = np.maximum(0.2 + 0.1 * np.linspace(0, 1, 10001), 0.25)
    truth = 0.25 * NOISE / 4 * math.sqrt(np.mean(scale**-2.0))
    assert abs(even.relative.value - truth) < 4 * even.relative.error + 0.02 * truth
    aimed = bench.measure_counts({"queries.target_error": "10%"}, True, 0.0)
    assert aimed.relative is not None
    assert aimed.paths is not None
    assert 0.08 < aimed.relative.value < 0.1
    assert aimed.paths > 4 * (NOISE / 0.4) ** 2 + 16


def test_seeds_change_the_measurement_and_nothing_else_does(bench: GeneratorBenchmark) -> None:
    again = GeneratorBenchmark(bench.config, bench.material, 0)
    other = GeneratorBenchmark(bench.config, bench.material, 1)
    noise = [b.measure({"queries.spp": 8}, None, 0.0).noise for b in (bench, again, other)]
    assert noise[0] == noise[1]
    assert noise[0].value != noise[2].value
    assert abs(noise[0].value - noise[2].value) < 4 * math.hypot(noise[0].error, noise[2].error)


def test_every_setting_is_one_that_the_generator_takes(bench: GeneratorBenchmark) -> None:
    tasks = list(generator_tasks(bench))
    for task in tasks:
        plan_effects(bench.job(task.changes), pilots=False)
    names = {t.name for t in tasks if t.study == "effects"}
    assert {"auto", "all", "without shadowing", "without interreflection"} <= names
    assert sum(t.study == "adaptive" for t in tasks) == 2 * len(COUNTS) + len(TARGETS)
    # Commands give queries the paths that they were measured with: as many each, but where ways to count
    # them are compared.
    for task in tasks:
        command = task.command("mbtf-gen m")
        wanted = task.changes.get("queries.allocation", None if task.study == "adaptive" else "uniform")
        assert f"allocation={wanted}" in command if wanted else "allocation" not in command


def test_other_work_on_the_machine_does_not_change_the_price() -> None:
    from mbtf_pipeline.cost_study.generator_benchmark import _typical

    quiet = [1.0, 1.02, 0.98, 1.01, 0.99, 1.0, 1.03]
    found = _typical([*quiet, 9.0])
    assert abs(found.value - 1.0) < 0.02
    assert 0.0 < found.error < 0.02


def test_bars_hold_the_error_of_the_mean_that_they_are_relative_to(
    bench: GeneratorBenchmark, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fake values are even, and so is their mean: known to 3e-4. Relative to one that is known to a tenth
    noise and bias are no better known."""
    mean = bench.mean({})
    assert abs(mean.value - 0.25) < 4 * mean.error < 0.25 * 2e-3
    changes = {"transport.max_depth": 1, "queries.spp": 8}
    found = bench.measure(changes, {}, 0.0)
    monkeypatch.setattr(bench, "mean", lambda against: Estimate(mean.value, 0.1 * mean.value, 9))
    wide = bench.measure(changes, {}, 0.0)
    assert found.bias is not None
    assert wide.bias is not None
    for a, b in ((found.noise, wide.noise), (found.bias, wide.bias), (found.error, wide.error)):
        assert b.value == a.value
        assert b.error == pytest.approx(math.hypot(a.error, 0.1 * a.value), rel=1e-3)


def test_queries_without_paths_come_in_pieces_no_larger(bench: GeneratorBenchmark) -> None:
    """Closed forms take none: as many queries as a piece has paths would not fit into memory."""
    sizes: list[int] = []

    def trace(queries: Any, stream: Any) -> Any:
        sizes.append(len(queries.sigma))
        zero = np.zeros((sizes[-1], 3), np.float32)
        return SimpleNamespace(value_a=zero, value_b=zero)

    variance, _ = bench._noise(bench.job({}), trace, 1e-3, 0.0, 0.25)
    assert variance.value == 0
    assert set(sizes) == {1 << 18}


@pytest.mark.parametrize(
    ("factor", "spread", "message"),
    [(0.0, 0.0, "reflects nothing"), (1.0, 0.0, "reflects the same everywhere"), (1.0, 0.02, None)],
)
def test_materials_without_anything_to_learn_are_refused(
    monkeypatch: pytest.MonkeyPatch, factor: float, spread: float, message: str | None
) -> None:
    """Noise does not count; values that vary by a fiftieth of their mean do."""
    from mbtf_gen.render.estimates import Estimates, Stream
    from mbtf_gen.sampling.query_sampler import Queries
    from mbtf_pipeline.cost_study.study import _check_variation

    class Even(FakeEstimator):
        def estimate(self, queries: Queries, spp: Any, stream: Stream, **_: Any) -> Estimates:
            found = super().estimate(queries, spp, stream)
            truth = 0.2 + 0.1 * queries.u[:, :1]
            own = 0.25 * (1 + spread * np.sign(queries.u[:, :1] - 0.5))
            halves = (
                (factor * (0.1 * (v - truth) + own)).astype(np.float32)
                for v in (found.value_a, found.value_b)
            )
            return replace(found, **dict(zip(("value_a", "value_b"), halves, strict=True)))

    bench = fake_benchmark(monkeypatch)
    target = "mbtf_pipeline.cost_study.generator_benchmark.build_estimator"
    monkeypatch.setattr(target, lambda job, plan: Even(job))
    if message is None:
        _check_variation(bench)
        return
    with pytest.raises(InputError, match=message):
        _check_variation(bench)

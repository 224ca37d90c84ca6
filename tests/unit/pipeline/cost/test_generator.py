"""Cost studies of the generator: seconds, bias and noise are found where they are known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from support.fake_benchmark import NOISE, SHIFT, FakeEstimator, fake_benchmark
from support.fake_runs import conditions

from mbtf_core.errors import InputError
from mbtf_core.stats import Estimate
from mbtf_gen.planning.run_plan import plan_effects
from mbtf_pipeline.cost import generator as module
from mbtf_pipeline.cost.generator import (
    GeneratorBenchmark,
    generator_configurations,
)
from mbtf_pipeline.cost.measurement import Measurement
from mbtf_pipeline.cost.runs import planned_runs


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> GeneratorBenchmark:
    return fake_benchmark(monkeypatch)


# The reference with all effects.
ALL: dict[str, Any] = {}


def measure(benchmark: GeneratorBenchmark, changes: dict[str, Any], against: Any = ALL) -> Measurement:
    return Measurement("paths", "", "", "", *benchmark.measure(changes, against, 0.0))


@pytest.mark.parametrize("spp", [4, 64])
def test_bias_and_noise_are_separated(benchmark: GeneratorBenchmark, spp: int) -> None:
    found = measure(benchmark, {"transport.max_depth": 1, "queries.spp": spp})
    # Relative to the mean value 0.25: the bias is the shift times the values, the noise that of spp paths.
    bias = SHIFT * math.sqrt(np.mean((0.2 + 0.1 * np.linspace(0, 1, 10001)) ** 2)) / 0.25
    noise = NOISE / math.sqrt(spp)
    assert found.bias is not None
    for estimate, truth in ((found.bias, bias), (found.noise, noise), (found.error, math.hypot(bias, noise))):
        assert abs(estimate.value - truth) < 4 * estimate.error
        assert estimate.error < 0.05 * truth
    assert found.seconds.value > 0


def test_an_unbiased_configuration_shows_no_bias(benchmark: GeneratorBenchmark) -> None:
    found = measure(benchmark, {"transport.max_depth": 3})
    assert found.bias is not None
    assert found.bias.value == 0.0
    assert measure(benchmark, {"queries.spp": 8}, None).bias is None


def test_error_bars_agree_with_other_seeds(benchmark: GeneratorBenchmark) -> None:
    """Differences of seeds over their error bars; a bar too narrow by a factor 2 gives a deviation of 2."""
    changes = {"transport.max_depth": 1, "queries.spp": 8}
    configs = [benchmark.config.model_copy(update={"seed": seed}) for seed in (*range(6), 0)]
    runs = [GeneratorBenchmark(config, benchmark.material) for config in configs]
    *found, again = (measure(run, changes) for run in runs)
    assert (again.noise, again.bias) == (found[0].noise, found[0].bias)
    for part in ("noise", "bias", "error"):
        estimates: list[Estimate] = [getattr(one, part) for one in found]
        spread = np.std([e.value for e in estimates], ddof=1)
        assert 0.4 < spread / np.mean([e.error for e in estimates]) < 1.9


def test_every_configuration_is_one_that_the_generator_takes(
    benchmark: GeneratorBenchmark, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "plan_effects", plan_effects)
    tasks = list(generator_configurations(benchmark))
    commands = [c.command(conditions()).split() for c in (*tasks, *planned_runs(3600.0, 6, 1.5e-7))]
    outputs = [words[i + 1] for words in commands for i, word in enumerate(words) if word == "-o"]
    assert len({*outputs}) == len(outputs) > len(commands)
    for task in tasks:
        job = benchmark.job(task.changes)
        plan_effects(job, pilots=False)
        # The command sets what was measured, and nothing else.
        words = task.command(conditions()).split()
        given = dict(w.split("=") for w, flag in zip(words[1:], words, strict=False) if flag == "--set")
        assert given == {name: str(value) for name, value in task.changes.items()}
    # The rate of the recipe's own number of paths is measured first.
    assert tasks[0].changes["queries.spp"] == benchmark.config.queries.spp
    assert len({task.label for task in tasks}) == len({str((t.study, t.key)) for t in tasks}) == len(tasks)
    # All queries have equally many paths, except where allocations are compared.
    uniform = [t for t in tasks if t.study != "paths" or t.series == "uniform"]
    assert {benchmark.job(t.changes).config.queries.allocation for t in uniform} == {"uniform"}


def test_materials_without_anything_to_learn_are_refused(
    benchmark: GeneratorBenchmark, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise does not count; a standard deviation of a fiftieth of the mean is something."""
    monkeypatch.setattr(FakeEstimator, "noise", 0.1 * NOISE)
    monkeypatch.setattr(FakeEstimator, "slope", 0.02 * 0.25 * math.sqrt(12))
    benchmark.check_variation()
    for name, message in (("slope", "reflects the same everywhere"), ("scale", "reflects nothing")):
        monkeypatch.setattr(FakeEstimator, name, 0.0)
        again = GeneratorBenchmark(benchmark.config, benchmark.material)
        with pytest.raises(InputError, match=message):
            again.check_variation()

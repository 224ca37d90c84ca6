"""Cost studies of the generator: seconds, bias and noise are found where they are known."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.fake_runs import conditions

from mbtf_core.data.schema import Queries
from mbtf_core.errors import InputError
from mbtf_core.stats import Estimate
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.run import Job
from mbtf_gen.planning.run_plan import plan_effects
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_pipeline.cost import generator as module
from mbtf_pipeline.cost.generator import (
    GeneratorBenchmark,
    generator_configurations,
)
from mbtf_pipeline.cost.measurement import Measurement
from mbtf_pipeline.cost.runs import planned_runs

NOISE = 0.8  # standard deviation of one path, relative to the value
SHIFT = 0.25  # bias of one interaction, relative to the value


class FakeEstimator:
    """Values of known bias and noise, between 0.2 and 0.3 along u; random numbers depend on the stream alone,
    as the real ones."""

    scale, slope, noise = 1.0, 0.1, NOISE

    def __init__(self, job: Job) -> None:
        self.shift = SHIFT if job.config.transport.max_depth == 1 else 0.0

    def estimate(
        self, queries: Queries, spp: Any, stream: Stream, *, path_variance: bool = False, lights: int = 1
    ) -> Estimates:
        # A biased configuration traces other paths.
        key = [stream.root, stream.shard, stream.first_pass, len(queries.sigma), self.shift > 0]
        rng = np.random.default_rng(key)
        each = np.broadcast_to(spp, len(queries.sigma))
        truth = self.scale * (0.25 + self.slope * (queries.u[:, :1] - 0.5))
        # The bias has both signs: its square is measured, query by query.
        sign = np.where(queries.u[:, 1:] < 0.5, -1.0, 1.0)
        halves = [
            truth * (1 + self.shift * sign)
            + 0.25 * self.scale * self.noise * rng.normal(size=(len(truth), 3)) / np.sqrt(each[:, None] / 2)
            for _ in range(2)
        ]
        a, b = (h.astype(np.float32) for h in halves)
        known = np.full(len(truth), (0.25 * NOISE) ** 2, np.float32) if path_variance else None
        return Estimates(a, b, None, int(each.sum()), 0, 0, 0, path_variance=known)


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> GeneratorBenchmark:
    """A small height field, traced by :class:`FakeEstimator`."""
    plan = SimpleNamespace(effects=SimpleNamespace(closed_form=False), allocation=None)
    monkeypatch.setattr(module, "build_estimator", lambda job, plan: FakeEstimator(job))
    monkeypatch.setattr(module, "plan_effects", lambda job: plan.effects)
    monkeypatch.setattr(module, "allocate", lambda job, effects: plan)
    heights = np.random.default_rng(0).random((128, 128))
    material = HeightFieldTile(heights, height_scale=0.1, maps={"base_color": np.array([0.5, 0.5, 0.5])})
    return GeneratorBenchmark(GeneratorConfig(material="heights.npy"), material)


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

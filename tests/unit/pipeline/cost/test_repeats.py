"""Runs with other seeds: means with honest error bars, none measured twice."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.fake_runs import TRUE, FakeRuns, MemoryStore, conditions, run

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost.measurement import (
    PRIOR,
    PRIOR_DEGREES,
    Measurement,
    combined,
    seed_deviation,
)
from mbtf_pipeline.cost.runs import Run
from mbtf_pipeline.cost.study import Measurements

RUNS = [run(3000, "long", 9.0), run(3000, "short", 4.0), run(2000, "one"), run(2000, "two")]
RUNS += [run(1000 + n, f"{n}") for n in range(8)]
Repeat = Callable[..., list[list[Measurement]]]


@pytest.fixture
def repeat(monkeypatch: pytest.MonkeyPatch) -> Repeat:
    """Measures RUNS until `most` are measured; returns the measurements of each."""

    def measured(store: MemoryStore, fake: FakeRuns, most: int = 10**6) -> Any:
        monkeypatch.setattr(Run, "measure", lambda run, conditions: fake.measure(run))
        found = Measurements(conditions(), store)  # type: ignore[arg-type]
        planned = [replace(run, seed=seed) for seed in range(2) for run in RUNS]
        found.measure_runs(planned, lambda run: len(fake.measured) < most)
        return [found.group(run) for run in RUNS]

    return measured


def test_nothing_is_measured_twice(repeat: Repeat) -> None:
    store = MemoryStore()
    first, second, third = FakeRuns(0.2), FakeRuns(0.2, study_seed=1), FakeRuns()
    some = repeat(store, first, most=14)
    assert [len(group) for group in some] == [2, 2] + 10 * [1]
    found = repeat(store, second)
    assert len(second.measured) == 2 * len(RUNS) - 14
    assert not {str(r.key) for r in first.measured} & {str(r.key) for r in second.measured}
    assert found[0] == some[0]
    assert repeat(store, third) == found
    assert not third.measured


@pytest.mark.parametrize(("deviation", "test"), [(0.06, 0.02), (0.03, 0.05)])
def test_error_bars_are_honest(repeat: Repeat, deviation: float, test: float) -> None:
    """Studies with other seeds: the difference from the truth over the error bar has mean 0 and deviation 1.
    An error bar too narrow by a factor 2 gives a deviation of 2."""
    deviations = []
    for seed in range(60):
        found = repeat(MemoryStore(), FakeRuns(deviation, test, study_seed=seed))
        pooled = seed_deviation(found)
        for group in found:
            error = combined(group, pooled).error
            deviations.append((error.value - TRUE) / error.error)
    # All runs of a study share the error of its test set, so there are fewer independent values.
    assert abs(np.mean(deviations)) < 4 / math.sqrt(60)
    assert 0.8 < np.std(deviations) < 1.2
    assert 0.9 < np.mean(np.abs(deviations) < 1.96) < 0.99


def measured(error: float, **details: float) -> Measurement:
    found = FakeRuns(0.0, 0.0).measure(run())
    return Measurement(**{**vars(found), "error": Estimate(error, 0.01 * error, 9), "details": details})


def test_the_seed_deviation_is_pooled_and_unbiased() -> None:
    random = np.random.default_rng(3)
    variances = []
    for _ in range(400):
        groups = [
            [measured(level * (1 + 0.05 * random.normal())) for _ in range(n)]
            for level, n in ((0.5, 2), (0.1, 2), (0.02, 3))
        ]
        found = seed_deviation(groups)
        assert found.degrees == PRIOR_DEGREES + 4
        # Of the repeats alone.
        variances.append((found.degrees * found.value**2 - PRIOR_DEGREES * PRIOR**2) / 4)
    assert np.mean(variances) == pytest.approx(0.05**2, rel=0.12)
    assert seed_deviation([[measured(0.5)], []]).value == PRIOR


def test_a_mean_has_the_error_of_its_seeds_and_test_sets() -> None:
    group = [measured(0.2, total_seconds=4.0), measured(0.3, total_seconds=6.0)]
    found = combined(group, Estimate(0.1, 0.02, 9))
    assert found.error.value == pytest.approx(0.25)
    assert found.error.error == pytest.approx(math.hypot(0.1 * 0.25 / math.sqrt(2), 0.0025))
    assert found.seconds.value == 5.0
    assert found.details == {
        "total_seconds": 5.0,
        "seeds": 2.0,
        "test_error": pytest.approx(0.01),
    }

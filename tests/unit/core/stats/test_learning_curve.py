"""Extrapolated learning curves: intervals contain known truths, and are not wider than they need be."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mbtf_core.stats import Estimate, LearningCurve

TIMES = np.geomspace(1.0, 4.0, 6)


def truth(power: float, level: float, time: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """A power law that levels off; 1 at four seconds."""
    return np.asarray(level + (1.0 - level) * (np.asarray(time) / 4.0) ** -power)


@pytest.mark.parametrize("deviation", [0.02, 0.05])
@pytest.mark.parametrize(("power", "level"), [(0.25, 0.0), (0.5, 0.0), (0.3, 0.3), (1.0, 0.6), (0.5, 1.0)])
def test_intervals_contain_the_truth(power: float, level: float, deviation: float) -> None:
    """Of curves with noise: the error at twenty times the time, the time of an error, the limit."""
    random, inside = np.random.default_rng(1), np.zeros(3)
    repeats = 50
    for _ in range(repeats):
        curve = LearningCurve(TIMES, truth(power, level, TIMES) * np.exp(deviation * random.normal(size=6)))
        error, limit = curve.error_at(80.0), curve.limit
        time = curve.time_of(float(truth(power, level, 20.0)))
        inside += (
            error.low <= truth(power, level, 80.0) <= error.high,
            time.low <= 20.0 * (1 + 1e-9) and time.high >= 20.0 * (1 - 1e-9),
            limit.low <= level <= limit.high,
        )
        assert error.low <= error.value <= error.high
        assert time.low <= time.value <= time.high
    assert (inside >= 0.83 * repeats).all(), inside / repeats


def test_more_measurements_narrow_the_interval() -> None:
    times = np.geomspace(1.0, 64.0, 13)
    few = LearningCurve(TIMES, truth(0.5, 0.2, TIMES) * (1 + 0.02 * (-1.0) ** np.arange(6)))
    many = LearningCurve(times, truth(0.5, 0.2, times) * (1 + 0.02 * (-1.0) ** np.arange(13)))
    exact = LearningCurve(TIMES, truth(0.5, 0.2, TIMES))
    wide, narrow, none = (curve.error_at(128.0) for curve in (few, many, exact))
    expected = float(truth(0.5, 0.2, 128.0))
    assert wide.high / wide.low > 2.0 * narrow.high / narrow.low
    assert narrow.value == pytest.approx(expected, rel=0.1)
    assert narrow.suffices
    assert none.value == pytest.approx(expected, rel=0.06)  # shapes are a grid
    found = many.time_of(expected)
    assert found.low < 128.0 < found.high < 1000.0


def test_levels_and_repeats_decide_what_is_reachable() -> None:
    level = LearningCurve(np.geomspace(1.0, 64.0, 13), truth(0.7, 0.5, np.geomspace(1.0, 64.0, 13)))
    assert level.limit.low == pytest.approx(0.5, rel=0.1)
    assert level.time_of(0.4).low == math.inf
    assert not level.time_of(0.4).suffices
    # What is reached already takes no more than it took.
    assert level.time_of(2.0).high < 4.0
    # Known scatter of many repeats, and means of several fits, replace that of few points.
    scattered = truth(0.5, 0.0, TIMES) * (1 + 0.02 * (-1.0) ** np.arange(6))
    alone = LearningCurve(TIMES, scattered).error_at(16.0)
    known = LearningCurve(TIMES, scattered, Estimate(0.02, 0.001, 60, 60)).error_at(16.0)
    assert known.high / known.low < 0.9 * alone.high / alone.low
    shared = LearningCurve(TIMES, scattered, Estimate(0.02, 0.001, 60, 60), shared=0.3).error_at(16.0)
    assert shared.high / shared.low > 3.0

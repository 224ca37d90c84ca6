"""Answers of cost studies to times and errors, and forecasts of runs that use them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost.answers import Evidence
from mbtf_pipeline.cost.measurement import Measurement, combined, seed_deviation

SECONDS = (10.0, 20.0, 40.0, 80.0, 160.0, 320.0)


OVERHEAD = 7.0


def law(seconds: float) -> float:
    """Error after a total time: a law of the seconds that generate and train."""
    return 0.03 + 0.3 * (seconds - OVERHEAD) ** -0.6


def times_of(seconds: float) -> dict[str, float]:
    work = seconds - OVERHEAD
    return {
        "generation_seconds": 0.35 * work, "training_seconds": 0.65 * work, "overhead_seconds": OVERHEAD
    }  # fmt: skip


def evidence(times: tuple[float, ...] = SECONDS) -> Evidence:
    found = [
        Measurement(
            "run", series, f"{s:g}", "command", Estimate(s, 0.0, 1),
            Estimate(law(s) * factor, 0.001, 9),
            details={"seeds": 2.0, "test_error": 0.02, **times_of(s)},
        )
        for series, factor, shown in (("35%", 1.0, times), ("60%", 2.0, times[:2]))
        for s in shown
    ]  # fmt: skip
    return Evidence.of(found, Estimate(0.03, 0.01, 6, 6))


def test_a_study_forecasts_times_and_errors() -> None:
    """By the law that its runs follow; runs of other shares, twice as bad here, do not count."""
    found = evidence()
    assert [m.seconds.value for m in found.runs] == list(SECONDS)
    for seconds in (60.0, 900.0):
        error = found.error_after(seconds)
        assert error is not None
        assert error.low < law(seconds) < error.high < 1.5 * error.low
    assert found.time_of(law(200.0)).startswith(f"error {law(200.0):g}: about ")
    assert "not reachable with this network, however many queries" in found.time_of(0.01)
    # The work of the longest run takes 313 s.
    assert "takes more than 20:59, where the forecast ends" in found.time_of(law(1900.0))
    assert found.error_after(1300.0) is None


def test_forecasts_of_short_studies_contain_the_truth() -> None:
    """Studies of two minutes, whose runs deviate as much as those of measured materials."""
    random, inside, times = np.random.default_rng(0), [], SECONDS[:3]
    for number in range(150):
        deviation = (0.015, 0.06)[number % 2]
        runs = [
            [replace(m, error=m.error.scaled(f)) for f in 1 + deviation * random.normal(size=n)]
            for m, n in zip(evidence(times).runs, (2, 2, 1), strict=True)
        ]
        pooled = seed_deviation(runs)
        error = Evidence.of([combined(group, pooled) for group in runs], pooled).error_after(120.0)
        assert error is not None
        assert error.suffices
        inside.append(error.low < law(120.0) < error.high)
    assert np.mean(inside) > 0.9

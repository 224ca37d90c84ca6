"""Training times of a library's fits."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_pipeline.library.budget import LEAST, Division, divide


def total_error(times: dict[str, float], factors: dict[str, float]) -> float:
    return sum(factors[name] / np.sqrt(times[name]) for name in times)


def test_the_sum_of_errors_is_least_if_errors_fall_like_the_root_of_the_time() -> None:
    factors = {"a": 0.05, "b": 0.1, "c": 0.2}
    times = divide(120.0, dict(factors))
    assert sum(times.values()) == pytest.approx(120.0, abs=0.01)
    best = total_error(times, factors)
    random = np.random.default_rng(1)
    for _ in range(200):
        other = dict(zip(factors, 120.0 * random.dirichlet([3, 3, 3]), strict=True))
        assert total_error(other, factors) >= best * (1 - 1e-6)


def test_no_fit_starves() -> None:
    times = divide(400.0, {"good": 1e-6, "also good": 0.0, "bad": 0.3, "worse": 0.9})
    assert min(times.values()) == pytest.approx(LEAST * 100.0)
    assert sum(times.values()) == pytest.approx(400.0, abs=0.01)
    assert times["worse"] > times["bad"] > times["good"]


def test_undefined_errors_count_as_the_mean() -> None:
    times = divide(300.0, {"a": 0.1, "b": 0.1, "constant": None})
    assert set(times.values()) == {100.0}
    assert divide(10.0, {"a": None}) == {"a": 10.0}
    assert divide(10.0, {"a": 0.0, "b": 0.0}) == {"a": 5.0, "b": 5.0}


def known(division: Division, errors: dict[str, float], key: str = "k") -> dict[str, float]:
    """Times after the first fits of these materials."""
    for name, error in errors.items():
        division.add(name, key, error)
    return division.times([(name, key) for name in errors])


def test_a_repaired_material_gets_the_share_that_waited() -> None:
    division = Division({}, 9.0, 0.2, count=3)
    assert division.first == pytest.approx(0.6)
    times = known(division, {"a": 0.1, "b": 0.2})
    assert sum(times.values()) == pytest.approx(2 * 2.4, abs=0.01)
    later = known(Division(division.record, 9.0, 0.2, count=3), {"a": 0.1, "b": 0.2, "repaired": 0.3})
    assert {name: later[name] for name in times} == times
    assert sum(later.values()) + 3 * division.first == pytest.approx(9.0, abs=0.01)


def test_a_further_material_changes_no_time() -> None:
    division = Division({}, 10.0, 0.2, count=2)
    times = known(division, {"a": 0.1, "b": 0.2})
    larger = Division(division.record, 10.0, 0.2, count=3)
    assert larger.has_error("a", "k")
    assert larger.first == division.first
    assert known(larger, {"a": 0.1, "b": 0.2, "added": 0.5}) == times | {"added": 4.0}


def test_changed_options_divide_the_times_that_they_had() -> None:
    division = Division({}, 30.0, 0.2, count=3)
    times = known(division, {"a": 0.1, "b": 0.2, "c": 0.3})
    for name, error in (("a", 0.5), ("b", 0.5)):
        assert not division.has_error(name, "other")
        division.add(name, "other", error)
    later = division.times([("a", "other"), ("b", "other"), ("c", "k")])
    assert later["c"] == times["c"]
    assert later["a"] == later["b"] == pytest.approx((times["a"] + times["b"]) / 2, abs=0.01)

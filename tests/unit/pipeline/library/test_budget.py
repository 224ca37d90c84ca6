"""Training times of a library's fits."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_pipeline.library.budget import LEAST, divide


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
    times = divide(400.0, {"good": 1e-6, "also good": 0.0, "bad": 1.0, "worse": 3.0})
    assert min(times.values()) == pytest.approx(LEAST * 100.0)
    assert sum(times.values()) == pytest.approx(400.0, abs=0.01)
    assert times["worse"] > times["bad"] > times["good"]


def test_undefined_errors_count_as_the_mean() -> None:
    times = divide(300.0, {"a": 0.1, "b": 0.1, "constant": None})
    assert set(times.values()) == {100.0}
    assert divide(10.0, {"a": None}) == {"a": 10.0}
    assert divide(10.0, {"a": 0.0, "b": 0.0}) == {"a": 5.0, "b": 5.0}

"""Estimates, their printing, groups and refusals, and the example of ``examples/dataset_statistics.py``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.datasets import write_dataset
from support.paths import ROOT

from mbtf_core import stats
from mbtf_core.data.lattice import sigma_of_level
from mbtf_core.errors import InputError
from mbtf_core.stats import (
    Estimate,
    by_group,
    elevation_groups,
    level_groups,
    local_error,
    mean_estimate,
    mean_of_halves,
    noise_free_mse,
    pooled_variance,
    signal_variance,
    t_test,
    unexplained_variance,
)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.31798, 0.0041, "0.318 ± 0.004"),
        (3.18e-5, 4e-7, "(3.18 ± 0.04)e-05"),
        (0.5, 0.0, "0.5 ± 0"),
        (0.5, math.inf, "0.5 ± ?"),
        (math.nan, math.inf, "undefined"),
    ],
)
def test_estimates_print_with_as_many_digits_as_they_know(value: float, error: float, text: str) -> None:
    assert str(Estimate(value, error, 10)) == text


@pytest.mark.parametrize("weighted", [False, True])
def test_queries_of_a_group_count_as_one(weighted: bool) -> None:
    """Four copies of every query know no more than one."""
    random = np.random.default_rng(0)
    p, a, b = random.normal(size=(3, 200, 3))
    b += 2 * a
    weights = random.uniform(1, 3, 200) if weighted else None
    groups = np.tile(np.arange(200), 4)
    statistics = {noise_free_mse: (p, a, b), unexplained_variance: (p, a, b), signal_variance: (a, b)}
    for statistic, arrays in statistics.items():
        one = statistic(*arrays, weights)  # type: ignore[operator]
        copies = [None if x is None else np.concatenate([x] * 4) for x in (*arrays, weights)]
        four = statistic(*copies, groups)  # type: ignore[operator]
        assert four.error == pytest.approx(one.error, rel=0.01)
        assert four.n == one.n == 200


def test_one_query_and_constant_data_have_no_unexplained_share() -> None:
    one = np.ones((1, 3))
    assert math.isnan(signal_variance(one, one).value)
    assert math.isnan(unexplained_variance(one, one, one).value)
    values = np.full((100, 3), 0.2)
    result = unexplained_variance(values + 0.1, values, values)
    assert math.isnan(result.value)
    assert result.error == math.inf
    with pytest.raises(ValueError, match="cannot be tested"):
        t_test(result, 0.0)


def test_numbers_that_are_not_finite_are_refused_with_their_place() -> None:
    a = np.ones((4, 3))
    a[2, 1] = np.nan
    with pytest.raises(
        InputError, match=r"value_b: 1 numbers are NaN or infinite, the first at index \(2, 1\)"
    ):
        pooled_variance(np.ones((4, 3)), a)


def test_the_noise_of_halves_has_a_degree_of_freedom_for_each_query_that_counts() -> None:
    a, b = np.random.default_rng(0).normal(size=(2, 20_000))
    assert mean_of_halves(a, b).dof == pytest.approx(20_000, rel=0.05)
    a[1:], b[1:] = 1e-6 * a[1:], 1e-6 * b[1:]
    assert mean_of_halves(a, b).dof == pytest.approx(1, rel=1e-3)


def test_groups() -> None:
    values = np.arange(6.0)
    found = by_group(mean_estimate, np.array([2, 0, 2, 0, -1, 2]), values)
    assert {label: e.value for label, e in found.items()} == {0: 2.0, 2: pytest.approx(7.0 / 3.0)}
    assert list(found) == [0, 2]
    with pytest.raises(ValueError, match="6 integers"):
        by_group(mean_estimate, np.ones(6), values)


def test_level_and_elevation_groups() -> None:
    sigma = sigma_of_level([0.0, 0.4, 0.6, 3.0, 7.4, -0.2])
    assert level_groups(sigma).tolist() == [0, 0, 1, 3, 7, 0]
    assert level_groups(sigma, finest=5).tolist() == [0, 0, 1, 3, 5, 0]
    omega = np.zeros((5, 3))
    omega[:, 2] = [0.0, 0.19, 0.2, 0.7, 1.0]
    assert elevation_groups(omega).tolist() == [0, 0, 1, 3, 3]
    up = np.tile([0.0, 0.0, 1.0], (5, 1))
    assert elevation_groups(up, omega).tolist() == [0, 0, 1, 3, 3]


def test_local_error_is_not_biased_by_noise() -> None:
    random = np.random.default_rng(1)
    truth = np.full((96, 96, 3), 0.5, np.float32)
    a, b = (truth + np.float32(0.2) * random.standard_normal(truth.shape, np.float32) for _ in range(2))
    picture = truth.copy()
    picture[:, 48:] += 0.3
    found = local_error(picture, a, b)
    assert found[:, 56:].mean() == pytest.approx(0.3, rel=0.05)
    # Without an error, the map lies far below the noise, and half of it is 0.
    assert np.median(found[:, :40]) < 0.05
    assert 0.3 < np.mean(found[:, :40] == 0) < 0.7
    assert (found >= 0).all()


EXAMPLE = (ROOT / "examples/dataset_statistics.py").read_text(encoding="utf-8")


def test_the_worked_example(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_dataset(tmp_path / "shards", queries={"train": "2000", "test": "4000"})
    monkeypatch.chdir(tmp_path)
    found: dict[str, Any] = {}
    exec(EXAMPLE, found)
    assert abs(stats.unexplained_variance(found["constant"], found["a"], found["b"]).value - 1.0) < 0.1
    assert found["better"].p_value < 1e-6
    # Two digits: the noise that the data were made with.
    assert "noise of one query: 0.03" in capsys.readouterr().out

"""Estimates are unbiased and their error bars correct, over repeated experiments with known truth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from mbtf_core.stats import (
    Estimate,
    mean_of_halves,
    mse_difference,
    noise_free_mse,
    pooled_error,
    pooled_relative_error,
    pooled_variance,
    signal_variance,
    unexplained_variance,
)

Floats = NDArray[np.float64]
Experiment = Callable[[np.random.Generator], Estimate]
EXPERIMENTS = 600
QUERIES = 1000
# Noise of the two halves differs, is skewed, and grows with the value: nothing in the kit may rely on less.
NOISE_A, NOISE_B = 0.5, 0.8


def draw(rng: np.random.Generator, shape: tuple[int, ...] = (QUERIES, 3)) -> tuple[Floats, Floats, Floats]:
    """Truth and two halves, (n, 3): channels share a factor, so they are correlated within a query."""
    shared = rng.normal(size=(shape[0],) + (1,) * (len(shape) - 1))
    truth = np.array([1.0, 2.0, 3.0]) + shared * np.array([0.5, 1.0, 1.5])
    truth = np.broadcast_to(truth, shape)
    a = truth + NOISE_A * (rng.exponential(size=shape) - 1.0)
    b = truth + NOISE_B * (rng.exponential(size=shape) - 1.0)
    return truth, a, b


def repeat(experiment: Experiment) -> list[Estimate]:
    rng = np.random.default_rng(20260101)
    return [experiment(rng) for _ in range(EXPERIMENTS)]


def normalized_deviations(experiment: Experiment, truth: float) -> tuple[Floats, Floats]:
    """Values over experiments, and their deviations from the truth in their own standard errors."""
    found = repeat(experiment)
    values = np.array([e.value for e in found])
    return values, (values - truth) / np.array([e.error for e in found])


def assert_honest(experiment: Experiment, truth: float) -> None:
    """Unbiased values (4.5σ); normalized deviations have standard deviation 1 (4.5σ, 3% for skewness)."""
    values, deviations = normalized_deviations(experiment, truth)
    assert abs(values.mean() - truth) < 4.5 * values.std(ddof=1) / np.sqrt(EXPERIMENTS)
    assert abs(deviations.std(ddof=1) - 1.0) < 4.5 / np.sqrt(2.0 * EXPERIMENTS) + 0.03


VARIANCE = (NOISE_A**2 + NOISE_B**2) / 4.0
SIGNAL = (0.5**2 + 1.0**2 + 1.5**2) / 3.0


@pytest.mark.parametrize(
    ("estimator", "truth"),
    [
        (pooled_variance, VARIANCE),
        (pooled_error, float(np.sqrt(VARIANCE))),
        (pooled_relative_error, float(np.sqrt(VARIANCE)) / 2.0),
        (signal_variance, SIGNAL),
    ],
)
def test_variances_of_noise_and_signal(estimator: Callable[[Floats, Floats], Estimate], truth: float) -> None:
    assert_honest(lambda rng: estimator(*draw(rng)[1:]), truth)


def test_noise_free_mse() -> None:
    def experiment(rng: np.random.Generator) -> Estimate:
        truth, a, b = draw(rng)
        return noise_free_mse(0.9 * truth + 0.1, a, b)

    mean = np.array([1.0, 2.0, 3.0])
    assert_honest(experiment, float(np.mean((0.1 - 0.1 * mean) ** 2)) + 0.01 * SIGNAL)


def test_weighted_queries_are_those_of_the_distribution() -> None:
    """Queries drawn three times as wide, with the ratio of densities as their weights."""

    def experiment(estimate: Callable[[Floats, Floats, Floats, Floats], Estimate]) -> Experiment:
        def weighted(rng: np.random.Generator) -> Estimate:
            x = 3.0 * rng.normal(size=(QUERIES, 1))
            truth = np.array([1.0, 2.0, 3.0]) + x * np.array([0.5, 1.0, 1.5])
            noise = rng.exponential(size=(2, *truth.shape)) - 1.0
            a, b = truth + NOISE_A * noise[0], truth + NOISE_B * noise[1]
            # Up to a factor.
            return estimate(0.9 * truth + 0.1, a, b, 7.0 * np.exp(x**2 / 18.0 - x**2 / 2.0)[:, 0])

        return weighted

    mse = float(np.mean((0.1 - 0.1 * np.array([1.0, 2.0, 3.0])) ** 2)) + 0.01 * SIGNAL
    assert_honest(experiment(noise_free_mse), mse)
    assert_honest(experiment(lambda p, a, b, w: signal_variance(a, b, w)), SIGNAL)
    assert_honest(experiment(lambda p, a, b, w: mse_difference(p, 0 * p, a, b, w)), mse - SIGNAL - 14 / 3)
    # A ratio of two means has a bias of order 1/n, here with few effective queries.
    values, deviations = normalized_deviations(experiment(unexplained_variance), mse / SIGNAL)
    assert values.mean() == pytest.approx(mse / SIGNAL, rel=3e-2)
    assert deviations.std(ddof=1) == pytest.approx(1, abs=0.2)


# Texels of an image share directions; with few images the correction for their means matters.
@pytest.mark.parametrize("shape", [(2, 3), (5, 3), (4, 3, 5, 3)])
def test_signal_variance_is_unbiased_for_few_queries_and_images(shape: tuple[int, ...]) -> None:
    values = np.array([e.value for e in repeat(lambda rng: signal_variance(*draw(rng, shape)[1:]))])
    allowed = 4.5 * values.std(ddof=1) / np.sqrt(EXPERIMENTS)
    assert abs(values.mean() - SIGNAL) < allowed
    uncorrected = SIGNAL * (1.0 - 1.0 / shape[0])
    assert abs(values.mean() - uncorrected) > allowed


def test_unexplained_variance() -> None:
    """A prediction that regresses to the mean by 40% leaves 16% of the variance."""

    def experiment(rng: np.random.Generator) -> Estimate:
        truth, a, b = draw(rng)
        mean = np.array([1.0, 2.0, 3.0])
        return unexplained_variance(mean + 0.6 * (truth - mean), a, b)

    assert_honest(experiment, 0.16)


def test_mse_difference_is_sharper_than_two_errors() -> None:
    """The paired difference detects an improvement that two separate error bars hide."""

    def experiment(rng: np.random.Generator) -> Estimate:
        truth, a, b = draw(rng)
        return mse_difference(truth + 0.10, truth + 0.12, a, b)

    assert_honest(experiment, 0.10**2 - 0.12**2)
    truth, a, b = draw(np.random.default_rng(5))
    p, q = truth + 0.10, truth + 0.12
    separate = [noise_free_mse(x, a, b).error for x in (p, q)]
    assert mse_difference(p, q, a, b).error < 0.3 * np.hypot(*separate)


def test_mean_of_halves_counts_noise_alone() -> None:
    """At fixed queries the mean varies by Monte Carlo noise only, not by the spread of the queries."""
    truth, _, _ = draw(np.random.default_rng(1))

    def experiment(rng: np.random.Generator) -> Estimate:
        noise = (s * (rng.exponential(size=truth.shape) - 1.0) for s in (NOISE_A, NOISE_B))
        return mean_of_halves(*(truth + n for n in noise))

    assert_honest(experiment, float(truth.mean()))

"""The tests keep their false-positive rate in null experiments and detect planted differences."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats as reference
from support.chi_square import Cap, chi_square_test
from support.significance import aggregate_test, holm

from mbtf_core.stats import mean_estimate, mean_of_halves, t_test

Floats = NDArray[np.float64]
EXPERIMENTS = 1000


def assert_uniform(p_values: list[float]) -> None:
    """Kolmogorov-Smirnov at 1e-3."""
    assert reference.kstest(p_values, "uniform").pvalue > 1e-3


def halves(rng: np.random.Generator, truth: Floats, noise: float = 1.0) -> tuple[Floats, Floats]:
    """Two halves with heavy-tailed noise of the given standard deviation (Student, 5 degrees of freedom)."""
    scale = noise / np.sqrt(5.0 / 3.0)
    a, b = (truth + scale * rng.standard_t(5, size=truth.shape) for _ in range(2))
    return a, b


@pytest.mark.parametrize("n", [2, 4, 20])
def test_t_test_is_uniform_for_few_samples(n: int) -> None:
    rng = np.random.default_rng(2)
    assert_uniform([t_test(mean_estimate(rng.normal(3.0, 2.0, n)), 3.0).p_value for _ in range(EXPERIMENTS)])


# One query, one pair: one degree of freedom. Many: the normal distribution.
@pytest.mark.parametrize("queries", [1, 1000])
def test_t_test_of_halves_is_uniform(queries: int) -> None:
    rng = np.random.default_rng(3)
    assert_uniform(
        [t_test(mean_of_halves(*rng.normal(size=(2, queries)))).p_value for _ in range(EXPERIMENTS)]
    )


def test_two_estimates_of_unequal_precision() -> None:
    rng = np.random.default_rng(5)
    p_values = [
        t_test(mean_estimate(rng.normal(1.0, 1.0, 12)), mean_estimate(rng.normal(1.0, 5.0, 8))).p_value
        for _ in range(EXPERIMENTS)
    ]
    assert_uniform(p_values)
    x, y = rng.normal(1.0, 1.0, 12), rng.normal(1.5, 5.0, 8)
    expected = reference.ttest_ind(x, y, equal_var=False).pvalue
    assert t_test(mean_estimate(x), mean_estimate(y)).p_value == pytest.approx(expected)


def test_correction_for_the_number_of_tests() -> None:
    p = np.array([[0.01, 0.04], [0.03, 0.005]])
    assert holm(p) == pytest.approx(np.array([[0.03, 0.06], [0.06, 0.02]]))
    p_values = np.random.default_rng(8).random((2000, 20))
    rate = np.mean([holm(row).min() < 0.05 for row in p_values])
    assert rate == pytest.approx(0.05, abs=4.0 * np.sqrt(0.05 * 0.95 / 2000))


class TestAggregate:
    """``aggregate_test`` on two data sets at the same queries, six groups."""

    GROUPS = np.repeat(np.arange(6), 1000)

    def truth(self, rng: np.random.Generator) -> Floats:
        """Values whose noise and size differ from query to query."""
        return rng.lognormal(0.0, 1.0, size=(6000, 1)) * np.array([0.5, 1.0, 1.5])

    def pair(
        self, rng: np.random.Generator, first: Floats, second: Floats
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Halves of two data sets whose noise is proportional to the value."""
        a1, b1 = halves(rng, np.zeros_like(first))
        a2, b2 = halves(rng, np.zeros_like(first))
        return first * (1 + a1), first * (1 + b1), second * (1 + 0.3 * a2), second * (1 + 0.3 * b2)

    def test_null(self) -> None:
        rng = np.random.default_rng(9)
        truth = self.truth(rng)
        alarms, single, scatter = 0, [], []
        for _ in range(300):
            result = aggregate_test(*self.pair(rng, truth, truth), self.GROUPS)
            alarms += result.p_value < 0.05
            for c in result.comparisons:
                if c.channel == 1 and c.kind == "mean":
                    single.append(c.p_value)
                elif c.channel == 0 and c.kind == "scatter":
                    scatter.append(c.estimate.value / c.estimate.error)
        assert len(result.comparisons) == 6 * 3 * 2
        assert alarms <= 300 * 0.05 + 4 * np.sqrt(300 * 0.05)
        assert_uniform(single)
        assert abs(np.mean(scatter)) < 4.5 / np.sqrt(len(scatter))
        assert np.std(scatter) == pytest.approx(1.0, abs=0.15)

    def test_a_bias_in_one_group_is_found_there(self) -> None:
        rng = np.random.default_rng(11)
        truth = self.truth(rng)
        other = truth * np.where(self.GROUPS == 4, 1.2, 1.0)[:, None]
        result = aggregate_test(*self.pair(rng, truth, other), self.GROUPS)
        assert result.p_value < 1e-3
        assert result.worst.group == 4
        assert "group 4" in str(result)

    def test_a_difference_that_averages_out_is_found_by_its_scatter(self) -> None:
        """Swapping neighbors keeps every mean, as a shifted or flipped map does."""
        rng = np.random.default_rng(12)
        truth = self.truth(rng)
        shifted = truth.reshape(-1, 2, 3)[:, ::-1].reshape(-1, 3)
        result = aggregate_test(*self.pair(rng, truth, shifted), self.GROUPS)
        means = [c.p_value for c in result.comparisons if c.kind == "mean"]
        assert result.p_value < 1e-3
        assert result.worst.kind == "scatter"
        assert min(means) > 1e-4


def lobe(seed: int, axis: Floats, degrees: float) -> Floats:
    """von Mises-Fisher directions about an axis, concentration 1/radians(degrees)²."""
    rng, kappa = np.random.default_rng(seed), 1.0 / np.radians(degrees) ** 2
    height = -np.log1p(-rng.random(50_000) * -np.expm1(-2 * kappa)) / kappa
    return Cap(axis).points(np.stack([height, rng.uniform(-np.pi, np.pi, 50_000)], axis=-1))


def lobe_density(w: Floats, axis: Floats, degrees: float) -> Floats:
    kappa = 1.0 / np.radians(degrees) ** 2
    height = ((w - axis) ** 2).sum(axis=-1) / 2.0
    return kappa / (2 * np.pi * -np.expm1(-2 * kappa)) * np.exp(-kappa * height)


@pytest.mark.parametrize("degrees", [0.05, 1.0, 30.0])
def test_narrow_and_wide_lobes(degrees: float) -> None:
    axis = np.array([0.6, -0.48, 0.64])
    w, cap = lobe(6, axis, degrees), Cap.of_angle(axis, min(180.0, 4.0 * degrees))
    # Rounding to single precision must not look like a fault.
    for right in (w, w.astype(np.float32)):
        assert chi_square_test(right, lambda d: lobe_density(d, axis, degrees), cap).p_value > 1e-3
    assert chi_square_test(w, lambda d: lobe_density(d, axis, 1.05 * degrees), cap).p_value < 1e-6
    aside = Cap(axis).points(np.array([[np.radians(degrees) ** 2 / 200.0, 1.0]]))[0]
    shifted = lobe(7, aside, degrees)
    assert chi_square_test(shifted, lambda d: lobe_density(d, axis, degrees), cap).p_value < 1e-3

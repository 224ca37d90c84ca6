"""Which queries get how many paths: fitted expectations, counts, and what a target error calls for."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import Queries
from mbtf_gen.planning.adaptive import MOST_CORRECTION, correction, needed_paths
from mbtf_gen.planning.sample_allocation import (
    Allocation,
    direction_terms,
    evaluate_terms,
    fit_allocation,
    fit_log_linear,
)
from mbtf_gen.render.estimates import Estimates
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan

SPP = 16


def some_queries(n: int = 20_000, shard: int = 0) -> Queries:
    return QueryPlan(Lattice(6), LevelMixture(0.6, 0.4), 0.1, "shuffled", 0, n).draw("train", shard, n)


def deviation(q: Queries) -> NDArray[np.float64]:
    """Noisy at fine levels and low lights."""
    level = -np.log2(2.0 * q.sigma.astype(np.float64))
    return np.asarray(0.05 * np.exp(0.3 * level) / q.omega_i[:, 2].astype(np.float64))


def pilot(q: Queries, paths: int = SPP, seed: int = 0) -> Estimates:
    """Values whose noise has the deviation above, around a tile mean of 0.2 · ω_o,z."""
    rng = np.random.default_rng(seed)
    noise = deviation(q)[:, None] * np.sqrt(2.0 / paths)
    a, b = (
        (0.2 * q.omega_o[:, 2:] + noise * rng.normal(size=(len(q.sigma), 3))).astype(np.float32)
        for _ in range(2)
    )
    return Estimates(a, b, None, 0, 0, 0, 0)


@pytest.fixture(scope="module")
def fitted() -> Allocation:
    q = some_queries()
    return fit_allocation(q, pilot(q), SPP, SPP)


def test_a_group_of_lights_has_the_paths_that_its_noise_takes() -> None:
    q = some_queries()
    # The noise follows the lights, which differ within a group: neighbors are queries of their own here.
    found = fit_allocation(q, pilot(q), SPP, SPP, lights=4)
    counts = found.counts(q, SPP, 4).reshape(4, -1)
    assert (counts == counts[0]).all()
    assert counts.mean() == pytest.approx(SPP, rel=0.02)
    # Neyman: in proportion to the root mean square of a group's deviations, rounded to powers of two.
    share = counts[0] / np.sqrt(np.mean(found.deviation(q).reshape(4, -1) ** 2, axis=0))
    middle = (counts[0] > 2) & (counts[0] < counts.max())
    assert share[middle].max() / share[middle].min() <= 2.0 + 1e-6
    alone = fit_allocation(q, pilot(q), SPP, SPP)
    assert 1.0 < found.gain < alone.gain


def glossy_pilot(q: Queries, seed: int) -> Estimates:
    """Noise of a sharp lobe, large where the half vector is the normal and seen by few paths."""
    half = q.omega_i.astype(np.float64) + q.omega_o
    square = (half[:, 0] ** 2 + half[:, 1] ** 2) / half[:, 2] ** 2
    size = 0.01 * (1.0 + 1e5 / (1.0 + 100.0 * square) ** 2)
    rng = np.random.default_rng(seed)
    size *= rng.exponential(size=len(size)) * np.where(rng.random(len(size)) < 0.004, 250.0, 0.05)
    a = (1.0 + size).astype(np.float32)[:, None].repeat(3, axis=1)
    return Estimates(a, np.ones_like(a), None, 0, 0, 0, 0)


def test_a_sharp_lobe_is_fitted_to_the_end() -> None:
    q = some_queries(8000)
    found = glossy_pilot(q, 1)
    noise = np.sqrt(np.mean((found.value_a.astype(np.float64) - found.value_b) ** 2, axis=-1))
    weights = fit_log_linear(direction_terms(q), noise)
    fit = np.exp(np.stack(direction_terms(q), axis=1) @ weights)
    # The constant has no ridge, so this holds at the optimum and nowhere else along it.
    assert fit.mean() == pytest.approx(noise.mean(), rel=1e-3)
    allocation = fit_allocation(q, found, SPP, SPP)
    assert allocation.counts(q, SPP).mean() == pytest.approx(SPP, rel=0.02)
    # s is the root mean square, which a pilot of few bright paths has well above the mean size.
    s = evaluate_terms(allocation.weights, direction_terms(q))
    assert s.mean() == pytest.approx(allocation.typical)
    assert np.mean(s**2) == pytest.approx(0.25 * SPP * np.mean(noise**2), rel=1e-3)


def test_a_failed_fit_gives_even_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    q = some_queries(2000)
    found = glossy_pilot(q, 1)
    monkeypatch.setattr("mbtf_gen.planning.sample_allocation._STEPS", 2)
    allocation = fit_allocation(q, found, SPP, 12)
    assert (allocation.counts(q, 12) == 12).all()
    mean = 0.5 * np.mean(found.value_a.astype(np.float64) + found.value_b)
    assert allocation.tile_mean(q) == pytest.approx(np.full(2000, mean))


def test_expected_deviations_and_means_follow_the_pilot(fitted: Allocation) -> None:
    q = some_queries(4000, shard=1)
    ratio = fitted.deviation(q) / deviation(q)
    assert np.quantile(ratio, [0.02, 0.98]) == pytest.approx([1.0, 1.0], rel=0.2)
    assert np.mean(ratio**2) == pytest.approx(1.0, rel=0.05)
    assert fitted.tile_mean(q) / (0.2 * q.omega_o[:, 2]) == pytest.approx(np.ones(4000), rel=0.35)


def test_counts_are_powers_of_two_about_the_needed_mean(fitted: Allocation) -> None:
    q = some_queries(shard=2)
    for spp in (SPP, 256):
        counts = fitted.counts(q, spp)
        assert counts.mean() == pytest.approx(spp, rel=0.06)
        assert (np.log2(counts) % 1 == 0).all()
        assert counts.min() >= 2
    # In proportion to the deviation, to the nearest power of two.
    share = fitted.counts(q, 256) / fitted.deviation(q)
    assert share.max() / share.min() < 2.0001


def test_counts_reduce_the_error_by_the_stated_gain(fitted: Allocation) -> None:
    q = some_queries(shard=3)
    variance = deviation(q) ** 2
    gain = np.mean(variance / SPP) / np.mean(variance / fitted.counts(q, SPP))
    assert gain > 1.3
    assert fitted.gain == pytest.approx(gain, rel=0.1)


def test_counts_of_a_query_do_not_depend_on_the_others(fitted: Allocation) -> None:
    q = some_queries(1000)
    some = q.take(slice(7, 9))
    assert (fitted.deviation(some) == fitted.deviation(q)[7:9]).all()
    assert (fitted.counts(some, SPP) == fitted.counts(q, SPP)[7:9]).all()


def test_no_noise_gives_even_counts() -> None:
    q = some_queries(500)
    value = np.full((500, 3), 0.1, np.float32)
    silent = fit_allocation(q, Estimates(value, value, None, 0, 0, 0, 0), SPP, SPP)
    assert (silent.counts(q, SPP) == SPP).all()
    assert silent.gain == 1.0


def test_an_expectation_below_the_pilots_is_raised() -> None:
    """In proportion to the tile mean's square, and by no more than a factor; one path decides nothing."""
    rng = np.random.default_rng(0)
    n = 4000
    mean = np.exp(rng.normal(size=n))
    deviation = 0.3 * mean
    for factor, expected in ((0.5, 1.0), (1.5, 1.5), (9.0, MOST_CORRECTION)):
        variance = (factor * deviation) ** 2 * rng.exponential(size=n)
        assert correction(variance, deviation, mean) == pytest.approx(expected, rel=0.05)
        variance[7] = 1e6
        assert correction(variance, deviation, mean) == pytest.approx(expected, rel=0.08)
    # Too few say nothing; nor does black.
    assert correction(9.0 * deviation[:100] ** 2, deviation[:100], mean[:100]) == 1.0
    assert correction(np.zeros(n), np.zeros(n), np.zeros(n)) == 1.0
    variance = ((1.5 * deviation) ** 2).astype(np.float32)
    found = Estimates(*np.zeros((2, n, 3), np.float32), None, 0, 0, 0, 0, path_variance=variance)
    needed, _ = needed_paths(found, 16, deviation, mean, 0.05)
    assert needed == pytest.approx(np.full(n, (1.5 * 0.3 / 0.05) ** 2), rel=1e-5)


def test_one_bright_path_of_a_pilot_allows_no_larger_error() -> None:
    paths = np.r_[50.0, np.zeros(15)]
    value = np.full((1, 3), paths.mean(), np.float32)
    variance = np.array([paths.var(ddof=1)], np.float32)
    found = Estimates(value, value, None, 0, 0, 0, 0, path_variance=variance)
    for expected in (0.0, 0.5):
        _, scale = needed_paths(found, 16, np.array([expected]), np.array([0.2]), 0.05)
        assert scale == pytest.approx([0.2], rel=1e-3)

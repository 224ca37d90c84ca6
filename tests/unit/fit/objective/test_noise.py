"""The variance model: pooled over queries it finds what the noise was made with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.fit_data import parallax, random_queries

from mbtf_core.data.lattice import Lattice
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.objective.noise import NoiseModel, typical_value, value_bound

LATTICE = Lattice(3)


def noisy(n: int = 60_000, wild: int = 0) -> tuple[ShardQueries, np.ndarray, np.ndarray]:
    """(queries, true values, variance of the mean): 0.2 t² or 0.05 t² by level, twice that at low angles."""
    random = np.random.default_rng(0)
    arrays = random_queries(random, n, LATTICE)
    true = parallax(*arrays.values())
    low = np.minimum(arrays["omega_i"][:, 2], arrays["omega_o"][:, 2]) < 0.2
    factor = np.where(arrays["sigma"] > 0.15, 0.2, 0.05) * np.where(low, 2.0, 1.0)
    variance = factor[:, None] * true**2
    # Gamma noise, each half with twice the variance of the mean.
    shape = true**2 / (2 * variance)
    a, b = (random.gamma(shape) / shape * true for _ in range(2))
    rows = random.choice(n, wild, replace=False)
    a[rows[::2]], b[rows[1::2]] = 1e5, 1e5
    return ShardQueries(*arrays.values(), a.astype(np.float32), b.astype(np.float32)), true, variance


@pytest.mark.parametrize("wild", [0, 5])
def test_variance_by_level_and_elevation_is_found(wild: int) -> None:
    """To 25% in every group (the factors are pooled where the levels' footprints are); wild values decide
    nothing."""
    queries, true, variance = noisy(wild=wild)
    model = NoiseModel.of(queries, LATTICE, 0.05)
    tensors = (torch.from_numpy(a) for a in (queries.sigma, queries.omega_i, queries.omega_o))
    found = model.variance(torch.from_numpy(true), *tensors).numpy()
    low = np.minimum(queries.omega_i[:, 2], queries.omega_o[:, 2]) < 0.2
    for coarse in (queries.sigma > 0.3, queries.sigma < 0.1):
        for elevation in (low, ~low):
            group = coarse & elevation
            assert found[group].mean() / variance[group].mean() == pytest.approx(1.0, abs=0.25)


def test_data_without_noise_have_none() -> None:
    queries, _, _ = noisy(2000)
    quiet = replace(queries, value_b=queries.value_a)
    for data in (quiet, quiet.take(slice(0))):
        found = NoiseModel.of(data, LATTICE, 0.05)
        assert not found.levels.any()
        assert found.ratio == 0.0


@pytest.mark.parametrize(("wild", "highlights"), [(0, 0), (5, 0), (0, 300)])
def test_the_ratio_is_noise_to_signal(wild: int, highlights: int) -> None:
    """To 15%, as the brightest are left out, with wild values or highlights or not; where true values do not
    vary and for a single query, it is the upper bound."""
    queries, true, variance = noisy(wild=wild)
    queries.value_a[:highlights] = queries.value_b[:highlights] = 5.0
    found = NoiseModel.of(queries, LATTICE, 0.05).ratio
    assert found == pytest.approx(variance.mean() / true.var(0).mean(), rel=0.15)
    assert NoiseModel.of(queries.take(slice(-1, None)), LATTICE, 0.05).ratio == 5.0
    random = np.random.default_rng(1)
    a, b = (random.normal(1.0, 0.1, queries.value_a.shape).astype(np.float32) for _ in range(2))
    assert NoiseModel.of(replace(queries, value_a=a, value_b=b), LATTICE, 1.0).ratio == 5.0


def test_the_typical_value_is_robust_to_outliers() -> None:
    value = np.random.default_rng(0).gamma(0.5, 2.0, (20_000, 3))
    assert typical_value(value) == pytest.approx(1.0, abs=0.05)
    value[:5] = 1e5
    assert typical_value(value) == pytest.approx(1.0, abs=0.05)
    assert typical_value(np.zeros((10, 3))) == 0.0
    assert typical_value(np.full((1, 3), 0.25)) == 0.25
    # Mostly black, with rare highlights: the median group has none.
    rare = np.zeros((5000, 3))
    rare[7] = 100.0
    assert typical_value(rare) == pytest.approx(0.02)


def test_values_are_bounded_by_twice_the_largest() -> None:
    values = np.full((100, 3), 0.1, np.float32)
    values[8] = 5.0
    assert value_bound(values, 0.1) == pytest.approx(100.0)
    # Few or black data leave room.
    assert value_bound(values[:4], 0.1) == value_bound(values, 0.0) == 10.0

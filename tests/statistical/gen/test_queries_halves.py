"""``value_a`` and ``value_b``: independent, equal in distribution, and an unbiased measure of the noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import ks_2samp
from support.scenes import LightKernel, direction, estimate, queries, rocks

from mbtf_core.stats import mean_estimate, t_test

N = 30_000
GRID = rocks(48, 0.2)
SURFACES = {
    # Rough enough that no value is an outlier that decides the moments.
    "principled": {"type": "principled", "base_color": {"type": "rgb", "value": 0.7}, "roughness": 0.5},
    "lambert": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}},
}


@pytest.fixture(
    scope="module", params=[("principled", 5.0, 2), ("principled", 1.0, 16), ("lambert", 0.0, 4)], ids=str
)
def halves(request: pytest.FixtureRequest) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both halves (N,) of one query, estimated N times."""
    surface, width, spp = request.param
    q = queries([0.3, 0.6], 0.2, direction(35, 60), direction(50, 200), N)
    e = estimate(GRID, SURFACES[surface], LightKernel(width), q, spp)
    return e.value_a[:, 1].astype(np.float64), e.value_b[:, 1].astype(np.float64)


Halves = tuple[NDArray[np.float64], NDArray[np.float64]]


def test_noise_of_the_halves_is_uncorrelated(halves: Halves) -> None:
    a, b = (x - x.mean() for x in halves)
    # Also of one query's half with the next query's, and of squares: what a shared path would show.
    for x, y in (
        (a, b),
        (a[1:], a[:-1]),
        (a[1:], b[:-1]),
        (b[1:], a[:-1]),
        (a**2 - np.mean(a**2), b**2 - np.mean(b**2)),
    ):
        assert t_test(mean_estimate(x * y)).p_value > 1e-3


def test_halves_are_equal_in_distribution(halves: Halves) -> None:
    a, b = halves
    assert a.std() > 0.05 * a.mean()
    assert ks_2samp(a, b).pvalue > 1e-3
    assert t_test(mean_estimate(a - b)).p_value > 1e-3


def test_their_difference_measures_the_variance_of_their_mean(halves: Halves) -> None:
    a, b = halves
    mean = 0.5 * (a + b)
    spread = (mean - mean.mean()) ** 2 * N / (N - 1)
    assert t_test(mean_estimate(spread - 0.25 * (a - b) ** 2)).p_value > 1e-3

"""Points sampled by the query sensor follow a Gaussian wrapped on the torus."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from support.chi_square import Rectangle, chi_square_test
from support.scenes import mi, queries

from mbtf_core.stats import mean_estimate, t_test
from mbtf_gen.sampling.rng import Purpose, stream_key, stream_number
from mbtf_gen.sampling.sobol import sequence

N = 1 << 18
CENTER = np.array([0.9, 0.05])


def points(sigma: float, aspect: float) -> NDArray[np.float64]:
    """uv (N, 2) of sampled footprint points, not wrapped."""
    sensor = mi.load_dict({"type": "mbtf_queries", "aspect": aspect})
    sensor.set_queries(queries(CENTER, sigma, [0, 0, 1], [0, 0, 1], 1))
    key = stream_key(4, stream_number("test", 2, Purpose.FOOTPRINT))
    # The first point of many queries: points of one query are no independent sample.
    words = (mi.UInt32(key & 0xFFFFFFFF), mi.UInt32(key >> 32))
    xi = sequence(*words, dr.arange(mi.UInt32, N), 0).next_2d()
    return np.array(sensor.footprint(dr.zeros(mi.UInt32, N), xi), np.float64).T


@pytest.mark.parametrize("aspect", [1.0, 0.5])
@pytest.mark.parametrize("sigma", [1e-3, 0.1, 3.0])
def test_points_have_the_mean_and_covariance_of_the_footprint(sigma: float, aspect: float) -> None:
    # Lengths in tile widths: on a tile half as high as wide, σ spans twice as much of v.
    x = (points(sigma, aspect) - CENTER) * (1.0, aspect) / sigma
    # Single precision places the center to 1e-8.
    allowed = 1e-7 / sigma
    for axis in (0, 1):
        mean = mean_estimate(x[:, axis])
        assert abs(mean.value) < 4 * mean.error + allowed
        assert t_test(mean_estimate(x[:, axis] ** 2), 1.0).p_value > 1e-3
        assert t_test(mean_estimate(x[:, axis] ** 4), 3.0).p_value > 1e-3
    assert t_test(mean_estimate(x[:, 0] * x[:, 1])).p_value > 1e-3


def wrapped(offset: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    """Density on the circle of length 1 of a Gaussian around 0, summed over its images."""
    images = offset[:, None] + np.arange(-30, 31)
    return np.exp(-0.5 * (images / sigma) ** 2).sum(axis=1) / (sigma * np.sqrt(2 * np.pi))


@pytest.mark.parametrize("aspect", [1.0, 0.5])
@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.5])
def test_on_the_torus_they_follow_the_wrapped_gaussian(sigma: float, aspect: float) -> None:
    p = points(sigma, aspect)

    def density(q: NDArray[np.float64]) -> NDArray[np.float64]:
        return wrapped(q[:, 0] - CENTER[0], sigma) * wrapped(q[:, 1] - CENTER[1], sigma / aspect)

    result = chi_square_test(p - np.floor(p), density, Rectangle(), (24, 24))
    assert result.p_value > 1e-3, str(result)

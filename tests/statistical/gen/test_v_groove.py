"""Symmetric V-grooves under a delta light: tile means and footprints against the closed form."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from support.closed_forms import Groove
from support.scenes import DIRECT, HeightGrid, direction, estimate, lambert, queries, tile_mean_queries
from support.significance import aggregate_test

from mbtf_core.stats import Estimate, mean_of_halves, t_test
from mbtf_gen.sampling.light_kernel import LightKernel

ALBEDO = 0.7
GROOVE = Groove(0.4, ALBEDO)

PAIRS = [
    ((70, 0), (80, 0)),
    ((35, 0), (50, 0)),
    ((35, 10), (50, 200)),
    ((20, 180), (60, 30)),
    ((12, 0), (15, 180)),
    ((15, 60), (25, 75)),
    ((50, 90), (10, 0)),
]


def footprint_mean(
    u: NDArray[np.float64], sigma: float, omega_i: NDArray[np.float64], omega_o: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Closed form convolved with the footprint, at positions u (n,)."""
    n = 1 << 18
    x = (np.arange(n) + 0.5) / n
    damping = np.exp(-2.0 * (np.pi * sigma * np.arange(n // 2 + 1)) ** 2)
    blurred = np.fft.irfft(np.fft.rfft(GROOVE.value(x, omega_i, omega_o)) * damping, n)
    return np.interp(u, x, blurred, period=1.0)


@pytest.mark.parametrize("count", [1, 1024])
@pytest.mark.parametrize(("light", "view"), PAIRS)
def test_tile_mean(light: tuple[float, float], view: tuple[float, float], count: int) -> None:
    """Fine grooves have the mean of a large one."""
    omega_i, omega_o = direction(*light), direction(*view)
    expected = GROOVE.tile_mean(omega_i, omega_o)
    e = estimate(
        HeightGrid(np.tile(GROOVE.grid.z / count, count), 1.0),
        lambert(ALBEDO),
        LightKernel(0.0),
        tile_mean_queries(omega_i, omega_o, 20_000),
        16,
        transport=DIRECT,
    )
    mean = mean_of_halves(e.value_a[:, 0], e.value_b[:, 0])
    assert mean.error < 6e-3 * max(expected, 0.05)
    # A facet that fills the view has no variance at all; single precision is what remains.
    rounded = Estimate(mean.value, float(np.hypot(mean.error, 1e-6 * expected)), mean.n)
    assert t_test(rounded, expected).p_value > 1e-4
    assert e.lost == 0


@pytest.mark.parametrize("sigma", [0.02, 0.08, 0.3])
@pytest.mark.parametrize(("light", "view"), PAIRS[1:])
def test_finite_footprint(light: tuple[float, float], view: tuple[float, float], sigma: float) -> None:
    omega_i, omega_o = direction(*light), direction(*view)
    n = 3000
    u = np.random.default_rng(3).random((n, 2))
    e = estimate(
        GROOVE.grid,
        lambert(ALBEDO),
        LightKernel(0.0),
        queries(u, sigma, omega_i, omega_o, n),
        64,
        transport=DIRECT,
    )
    exact = footprint_mean(u[:, 0], sigma, omega_i, omega_o)[:, None]
    # Mean and scatter, by thirds of the tile: a mirrored or shifted profile has the right mean.
    thirds = np.floor(3 * u[:, 0]).astype(int)
    # Groups that see one facet alone have no variance; a dither stands for their rounding to single
    # precision.
    dither = np.random.default_rng(8).normal(scale=2e-5, size=(2, n, 1))
    a, b = e.value_a[:, :1] + dither[0], e.value_b[:, :1] + dither[1]
    # A third that expects a handful of lit paths in all has no normal mean: leave it out.
    for third in range(3):
        lit = exact[thirds == third].sum() / (ALBEDO / np.pi) * 64
        if lit < 100:
            thirds[thirds == third] = -1
    if np.all(thirds < 0):
        # Light and view from opposite sides, both low: no facet has both.
        assert e.value_a.mean() < 1e-3
        return
    result = aggregate_test(a, b, exact, exact, thirds, minimum=500)
    assert result.p_value > 1e-3, str(result)

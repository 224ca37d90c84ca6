"""Energy and reciprocity of displaced tiles, interreflection included."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import (
    DIRECT,
    Transport,
    direction,
    estimate,
    lambert,
    real_heights,
    rocks,
    tile_mean_queries,
)

from mbtf_core.stats import Estimate, mean_of_halves, t_test
from mbtf_gen.sampling.light_kernel import LightKernel
from mbtf_gen.tile.heights import HeightGrid

ROUGH = {"type": "roughconductor", "alpha": 0.4, "distribution": "ggx", "material": "none"}
PAIRS = [((40, 0), (70, 120)), ((15, 30), (60, 250)), ((25, 200), (12, 90))]


@pytest.mark.parametrize("view", [(90, 0), (30, 40), (3, 100)])
def test_closed_white_furnace_returns_one(view: tuple[float, float]) -> None:
    omega_o = direction(*view)
    e = estimate(rocks(), lambert(1.0), None, tile_mean_queries([0, 0, 1], omega_o, 8000), 16)
    mean = mean_of_halves(e.value_a[:, 0], e.value_b[:, 0])
    # Nothing is absorbed, so roulette leaves almost every path alone and the answer is nearly exact; what a
    # ray offset swallows in creases must stay below 1e-4.
    assert mean.error < 1e-4
    assert abs(mean.value - 1.0) < 1e-4 + 4 * mean.error
    assert e.lost <= 2
    assert e.capped == 0


@pytest.mark.parametrize("light", [LightKernel(2.0), None], ids=["lobe", "furnace"])
def test_roulette_changes_nothing_but_the_noise(light: LightKernel | None) -> None:
    q = tile_mean_queries(direction(40, 60), direction(55, 200), 20_000)
    seeds = {r: Transport(roulette_depth=r) for r in (1, 1000)}.items()
    with_it, without = (estimate(rocks(), lambert(0.7), light, q, 16, transport=t, seed=r) for r, t in seeds)
    first, second = (mean_of_halves(e.value_a[:, 0], e.value_b[:, 0]) for e in (with_it, without))
    assert first.relative_error < 5e-3
    assert first.error > second.error
    assert t_test(first, second).p_value > 1e-3


@pytest.mark.parametrize("albedo", [0.02, 0.7])
@pytest.mark.parametrize("width", [1.0, 20.0])
def test_roulette_leaves_direct_light_alone(albedo: float, width: float) -> None:
    """Russian roulette must not affect direct light that BSDF sampling finds."""
    q = tile_mean_queries(direction(40, 60), direction(55, 200), 8_000)
    light, limits = LightKernel(width), [Transport(roulette_depth=r) for r in (1, 1000)]
    early, late = (estimate(rocks(), lambert(albedo), light, q, 8, transport=t) for t in limits)
    noise = [float(np.mean((e.value_a.astype(np.float64) - e.value_b) ** 2)) for e in (early, late)]
    assert noise[0] < 2.0 * noise[1]


def tile_mean(
    grid: HeightGrid, bsdf: Any, omega_i: NDArray[np.float64], omega_o: NDArray[np.float64], seed: int
) -> Estimate:
    """Tile mean over independent positions; its error has their variance and the noise of the paths."""
    q = tile_mean_queries(omega_i, omega_o, 30_000, seed)
    e = estimate(grid, bsdf, LightKernel(0.0), q, 16, seed=seed)
    v = 0.5 * (e.value_a + e.value_b)[:, 0].astype(np.float64)
    return Estimate(float(v.mean()), float(v.std(ddof=1) / np.sqrt(len(v))), len(v))


@pytest.mark.parametrize(
    ("heights", "bsdf"),
    [("turtle_shell", ROUGH), ("turtle_shell", lambert(0.9)), ("rock_cliff", lambert(0.9))],
    ids=["roughconductor", "lambert", "lambert cliff"],
)
@pytest.mark.parametrize(("light", "view"), PAIRS)
def test_tile_mean_is_reciprocal(
    heights: str, bsdf: dict[str, Any], light: tuple[float, float], view: tuple[float, float]
) -> None:
    grid = real_heights(heights)
    one, other = direction(*light), direction(*view)
    forward, backward = tile_mean(grid, bsdf, one, other, 1), tile_mean(grid, bsdf, other, one, 2)
    assert max(forward.relative_error, backward.relative_error) < 0.01
    assert t_test(forward, backward).p_value > 1e-3


@pytest.mark.parametrize("light", [(80, 0), (20, 130)])
def test_tile_mean_returns_at_most_what_arrives(light: tuple[float, float]) -> None:
    """∫ M cos θ_o dω_o of the tile mean is the albedo of the tile: positive, and below that of its facets."""
    omega_i = direction(*light)
    n = 40_000
    rng = np.random.default_rng(9)
    r, phi = np.sqrt(rng.random(n) * (1 - 1e-6)), 2 * np.pi * rng.random(n)
    omega_o = np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(1 - r * r)], axis=-1)
    q = tile_mean_queries(omega_i, omega_o, n)
    values = {}
    for name, transport in (("all", None), ("direct", DIRECT)):
        e = estimate(rocks(), lambert(1.0), LightKernel(0.0), q, 16, transport=transport)
        # Uniform on the projected disk: the cosine-weighted integral is π times the mean.
        v = np.pi * 0.5 * (e.value_a + e.value_b)[:, 0].astype(np.float64)
        values[name] = Estimate(float(v.mean()), float(v.std(ddof=1) / np.sqrt(n)), n)
    # Albedo 1 loses nothing: all of the light comes back, none of it more than once.
    assert t_test(values["all"], 1.0).p_value > 1e-3
    assert values["direct"].value < 1.0 - 5 * values["direct"].error

"""Values do not depend on the tile's origin, offsets of position or height, or the unit of length."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.scenes import (
    DIRECT,
    HeightGrid,
    LightKernel,
    Transport,
    direction,
    estimate,
    lambert,
    mi,
    queries,
    rocks,
    tile_mean_queries,
)

from mbtf_core.data.shard_files import read_shard, write_shard
from mbtf_core.stats import mean_of_halves
from mbtf_gen.render import scene

RELIEF = rocks(32)
LIGHT, VIEW = direction(35, 60), direction(50, 200)
N = 1500


def values(grid: HeightGrid, u: NDArray[np.float64], transport: Transport = DIRECT) -> NDArray[np.float64]:
    """Both halves' mean (n,) at positions u (n, 2) and σ = 0.01."""
    q = queries(u, 0.01, LIGHT, VIEW, len(u))
    e = estimate(grid, lambert(0.7), LightKernel(0.0), q, 16, transport=transport)
    return 0.5 * (e.value_a + e.value_b)[:, 0].astype(np.float64)


def positions() -> NDArray[np.float64]:
    """Multiples of 1/1024, half of them on the tile's border, of these some at its corner."""
    u = np.random.default_rng(2).integers(0, 1024, (N, 2)) / 1024
    u[: N // 4, 0] = 0
    u[N // 8 : N // 2, 1] = 0
    return u


@settings(max_examples=8)
@example(16, 16)
@example(31, 1)
@given(st.integers(0, 31), st.integers(0, 31))
def test_the_border_may_lie_anywhere(rows: int, columns: int) -> None:
    """A map rolled by whole texels, and positions with it: equal values up to rounding at shadow edges."""
    rolled = HeightGrid(np.roll(RELIEF.z, (rows, columns), (0, 1)), 1.0)
    u = positions()
    here, there = values(RELIEF, u), values(rolled, u + np.array([columns / 32, -rows / 32]))
    assert np.mean(np.abs(here - there) > 1e-3 * here.mean()) < 0.01
    assert abs(np.mean(there - here)) < 1e-3 * here.mean()


@pytest.mark.parametrize("along", [0, 1], ids=["tall", "long"])
def test_a_tile_may_be_many_times_as_long_as_wide(along: int) -> None:
    """64 copies of a tile in a row are one tile, although ray offsets have fewer significant digits."""
    count = 64
    row = np.concatenate([RELIEF.z] * count, axis=along)
    # Lengths are in widths of the tile.
    scale = 1.0 if along == 0 else 1.0 / count
    many = HeightGrid(row * scale, count if along == 0 else 1.0 / count)
    u = positions()
    n = len(u)
    place = np.random.default_rng(1).integers(0, count, n)
    v = u.copy()
    v[:, 1 - along] = (place + u[:, 1 - along]) / count

    def of(grid: HeightGrid, u: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
        q = queries(u, sigma, LIGHT, VIEW, n)
        e = estimate(grid, lambert(0.7), LightKernel(0.0), q, 16, transport=Transport(max_depth=4))
        assert e.lost == 0
        return 0.5 * (e.value_a + e.value_b)[:, 0].astype(np.float64)

    here, there = of(RELIEF, u, 0.01), of(many, v, 0.01 * scale)
    assert np.mean(np.abs(here - there) > 0.02 * here.mean()) < 0.015
    assert abs(np.mean(there - here)) < 4e-4 * here.mean()
    for view in (direction(80, 0), direction(3, 77)):
        q = queries(np.random.default_rng(0).random((n, 2)), 0.3 * scale, [0, 0, 1], view, n)
        e = estimate(many, lambert(1.0), None, q, 16)
        np.testing.assert_allclose([e.value_a.mean(), e.value_b.mean()], 1.0, atol=1e-3)
        assert e.lost <= 2


@pytest.mark.parametrize("shift", [(1.0, 0.0), (-3.0, 2.0), (1000.0, -1000.0)])
def test_positions_may_be_counted_from_far_away(shift: tuple[float, float]) -> None:
    """u + whole tiles: single precision represents multiples of 1/1024 exactly up to 16384."""
    u = positions()
    here, there = values(RELIEF, u), values(RELIEF, u + shift)
    assert np.mean(np.abs(here - there) > 1e-3 * here.mean()) < 0.03
    assert abs(np.mean(there - here)) < 2e-3 * here.mean()


def test_heights_may_be_counted_from_anywhere() -> None:
    """A map + 2¹⁰, in steps that double precision represents exactly, gives the same bits."""
    h = np.round(RELIEF.z * 2**20) / 2**20
    u = positions()
    here, there = (values(HeightGrid.from_map(h + offset, 1.0), u) for offset in (0.0, 1024.0))
    assert np.array_equal(here, there)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_the_unit_of_length_is_of_no_consequence(unit: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """With 1e-3 to 1e3 scene units per tile width: the same values and energy, and no lost rays."""
    u = positions()
    here = values(RELIEF, u)
    monkeypatch.setattr(scene, "LONG_SIDE", unit)
    there = values(RELIEF, u)
    assert np.mean(np.abs(here - there) > 1e-3 * here.mean()) < 0.01
    assert abs(np.mean(there - here)) < 1e-3 * here.mean()
    for view in (direction(90, 0), direction(1, 77)):
        e = estimate(RELIEF, lambert(1.0), None, tile_mean_queries([0, 0, 1], view, 4000), 16)
        mean = mean_of_halves(e.value_a[:, 0], e.value_b[:, 0])
        assert abs(mean.value - 1.0) < 2e-4 + 4 * mean.error
        assert e.lost <= 2


def test_huge_values_are_exact_and_survive_the_format(tmp_path: Path) -> None:
    """Towards a light 1e-6 above the horizon, albedo/π · (n·ω_i)/ω_i,z exceeds half precision."""
    slope = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 3), -1.0, np.float32)), "raw": True}
    bsdf = {"type": "mbtf_surface", "base_color": {"type": "rgb", "value": 0.9}, "slopes": slope}
    light = np.array([np.sqrt(1 - 1e-12), 0.0, 1e-6])
    q = queries(positions(), 0.01, light, direction(80, 40), N)
    e = estimate(HeightGrid(np.zeros((2, 2)), 1.0), bsdf, LightKernel(0.0), q, 4)
    expected = 0.9 / np.pi * (light[0] + light[2]) / np.sqrt(3) / np.float32(1e-6)
    assert expected > 1e5 > 65504
    np.testing.assert_allclose(e.value_a, expected, rtol=1e-5)
    arrays = {k: getattr(q, k) for k in ("u", "sigma", "omega_i", "omega_o")}
    arrays |= {"value_a": e.value_a, "value_b": e.value_b * np.float32(1e-14), "spp": q.sigma}
    for suffix in (".exr", ".npz"):
        write_shard(tmp_path / f"x{suffix}", arrays)
        back = read_shard(tmp_path / f"x{suffix}")
        for name, array in arrays.items():
            assert np.array_equal(back[name], array), name

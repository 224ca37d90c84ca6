"""Queries follow the distributions that the manifest states; exact functions are those of NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest

from mbtf_core.lattice import Lattice, level_of_sigma
from mbtf_gen.sampling.exact_math import exp2, sincos_turns
from mbtf_gen.sampling.query_sampler import Mixture, QueryPlan

LATTICE = Lattice(4, 0.5)
ROWS = 20_000


def plan(
    *, mixture: Mixture | None = None, min_cos: float = 0.1, root: int = 3, shard_rows: int = ROWS
) -> QueryPlan:
    return QueryPlan(LATTICE, mixture or Mixture(0.6, 0.4), min_cos, "shuffled", root, shard_rows)


@pytest.mark.parametrize("min_cos", [0.1, 0.7])
@pytest.mark.parametrize("name", ["omega_i", "omega_o"])
def test_directions_are_uniform_on_the_projected_disk(name: str, min_cos: float) -> None:
    omega = getattr(plan(min_cos=min_cos).draw("train", 0, ROWS), name).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(omega, axis=-1), 1.0, atol=1e-6)
    assert omega[:, 2].min() > min_cos - 1e-6
    # Uniform on a disk: radius² and azimuth are uniform and independent.
    radius2 = (1.0 - omega[:, 2] ** 2) / (1.0 - min_cos**2)
    turn = np.arctan2(omega[:, 1], omega[:, 0]) / (2 * np.pi) % 1.0
    assert kstest(radius2, "uniform").pvalue > 1e-3
    assert kstest(turn, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(radius2, turn)[0, 1]) < 4 / np.sqrt(ROWS)


def test_light_and_view_are_drawn_apart() -> None:
    q = plan().draw("train", 0, ROWS)
    for i in range(3):
        for o in range(3):
            assert abs(np.corrcoef(q.omega_i[:, i], q.omega_o[:, o])[0, 1]) < 4 / np.sqrt(ROWS)


@pytest.mark.parametrize(("log_uniform", "finest"), [(1.0, 0.0), (0.0, 1.0), (0.7, 0.3), (3.0, 1.0)])
def test_levels_follow_the_mixture(log_uniform: float, finest: float) -> None:
    k = LATTICE.finest
    q = plan(mixture=Mixture(log_uniform, finest)).draw("train", 0, ROWS)
    level = np.clip(level_of_sigma(q.sigma), 0.0, k)
    share = log_uniform / (log_uniform + finest)
    # Strata leave no scatter beyond one query per edge; rounding of σ to single precision moves few more.
    for edge in np.linspace(0.0, k, 9):
        expected = share * edge / k + (1 - share) * max(0.0, edge - (k - 1))
        assert np.mean(level < edge) == pytest.approx(expected, abs=3 / ROWS + 1e-4)
    # In random order: no trend along the shard, no tie to the directions.
    for other in (np.arange(ROWS), q.omega_i[:, 2], q.omega_o[:, 2], q.u[:, 0]):
        assert abs(np.corrcoef(level, other)[0, 1]) < 4 / np.sqrt(ROWS)


def test_footprints_stay_within_the_levels() -> None:
    sigma = plan().draw("train", 0, ROWS).sigma
    low, high = LATTICE.sigma_range
    assert sigma.min() >= np.float32(low)
    assert sigma.max() <= np.float32(high)
    # Level 0 has σ = 1/2.
    assert high == 0.5


def texels(u: np.ndarray) -> np.ndarray:
    rows, columns = LATTICE.shape()
    column = np.floor(u[:, 0].astype(np.float64) * columns).astype(int)
    row = np.floor((1.0 - u[:, 1].astype(np.float64)) * rows).astype(int) % rows
    return row * columns + column


def test_every_pass_visits_every_texel_once_across_shards() -> None:
    count = LATTICE.texels()
    shard_rows = 48
    shards = [plan(shard_rows=shard_rows).draw("train", s, shard_rows) for s in range(3 * count // 48)]
    visited = texels(np.concatenate([q.u for q in shards])).reshape(3, count)
    orders = {tuple(np.unique(order, return_index=True)[1]) for order in visited}
    # A position that single precision rounds onto a texel's edge counts for its neighbor.
    for order in visited:
        assert len(np.unique(order)) >= count - 1
    assert len(orders) == 3


def test_positions_fill_their_texels() -> None:
    rows, columns = LATTICE.shape()
    u = plan().draw("train", 0, ROWS).u.astype(np.float64)
    assert kstest(u[:, 0] * columns % 1.0, "uniform").pvalue > 1e-3
    assert kstest(u[:, 1] * rows % 1.0, "uniform").pvalue > 1e-3


def test_splits_shards_and_roots_draw_other_queries() -> None:
    drawn = [
        plan(root=root).draw(split, shard, 1000)
        for root, split, shard in ((3, "train", 0), (3, "train", 1), (3, "test", 0), (4, "train", 0))
    ]
    for a in range(4):
        for b in range(a):
            for name in ("u", "sigma", "omega_i", "omega_o"):
                one, other = (getattr(drawn[k], name).reshape(1000, -1)[:, 0] for k in (a, b))
                assert np.mean(one == other) < 0.01
                assert abs(np.corrcoef(one, other)[0, 1]) < 5 / np.sqrt(1000)


def test_exact_functions_are_those_of_numpy() -> None:
    x = np.random.default_rng(0).uniform(-15.0, 15.0, 10_000)
    np.testing.assert_allclose(exp2(x), np.exp2(x), rtol=1e-14)
    turns = np.concatenate([np.random.default_rng(1).random(10_000), np.arange(16) / 16])
    sine, cosine = sincos_turns(turns)
    np.testing.assert_allclose(sine, np.sin(2 * np.pi * turns), atol=2e-15)
    np.testing.assert_allclose(cosine, np.cos(2 * np.pi * turns), atol=2e-15)

"""Queries follow the distributions that the manifest states."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest

from mbtf_core.lattice import Lattice, level_of_sigma
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


def test_light_and_view_are_independent() -> None:
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


def test_positions_fill_their_texels() -> None:
    rows, columns = LATTICE.shape()
    u = plan().draw("train", 0, ROWS).u.astype(np.float64)
    assert kstest(u[:, 0] * columns % 1.0, "uniform").pvalue > 1e-3
    assert kstest(u[:, 1] * rows % 1.0, "uniform").pvalue > 1e-3


def test_splits_shards_and_roots_have_different_queries() -> None:
    samples = [
        plan(root=root).draw(split, shard, 1000)
        for root, split, shard in ((3, "train", 0), (3, "train", 1), (3, "test", 0), (4, "train", 0))
    ]
    for a in range(4):
        for b in range(a):
            for name in ("u", "sigma", "omega_i", "omega_o"):
                one, other = (getattr(samples[k], name).reshape(1000, -1)[:, 0] for k in (a, b))
                assert np.mean(one == other) < 0.01
                assert abs(np.corrcoef(one, other)[0, 1]) < 5 / np.sqrt(1000)

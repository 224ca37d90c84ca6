"""Queries follow the densities that the manifest states, jointly."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import kolmogorov
from support.chi_square import Cap, chi_square_test, uniformity
from support.significance import holm

from mbtf_core.data.lattice import Lattice, level_of_sigma
from mbtf_core.data.schema import Queries
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan

ROWS = 1 << 16
MIN_COS = 0.15
LATTICE = Lattice(7, 0.75)


def draw(
    layout: str = "shuffled", mixture: LevelMixture | None = None, lattice: Lattice = LATTICE
) -> Queries:
    plan = QueryPlan(lattice, mixture or LevelMixture(0.6, 0.4), MIN_COS, layout, 8, ROWS)  # type: ignore[arg-type]
    return plan.draw("train", 1, ROWS)


@pytest.fixture(scope="module")
def sampled() -> Queries:
    return draw()


@pytest.mark.parametrize("name", ["omega_i", "omega_o"])
def test_directions_are_uniform_on_the_projected_disk(name: str, sampled: Queries) -> None:
    """Uniform on the disk of radius √(1 - cos²_min): ω_z / (π (1 - cos²_min)) per steradian."""
    area = np.pi * (1 - MIN_COS**2)
    omega = getattr(sampled, name)
    result = chi_square_test(omega, lambda w: w[:, 2] / area, Cap((0.0, 0.0, 1.0), MIN_COS))
    assert result.p_value > 1e-3, str(result)


def coordinates(q: Queries, mixture: LevelMixture) -> dict[str, NDArray[np.float64]]:
    """Each query variable as a number that is uniform in [0, 1)."""
    span = 1 - MIN_COS**2
    level = level_of_sigma(q.sigma)
    k = LATTICE.finest
    cumulative = mixture.log_uniform * level / k + mixture.finest * np.maximum(0.0, level - (k - 1))
    out = {"u": q.u[:, 0], "v": q.u[:, 1], "level": cumulative}
    for name, omega in (("i", q.omega_i.astype(np.float64)), ("o", q.omega_o.astype(np.float64))):
        out[f"radius {name}"] = (1 - omega[:, 2] ** 2) / span
        out[f"azimuth {name}"] = np.arctan2(omega[:, 1], omega[:, 0]) / (2 * np.pi) % 1.0
    return {name: np.clip(x.astype(np.float64), 0.0, 1.0 - 1e-9) for name, x in out.items()}


def test_all_variables_are_uniform_and_pairwise_independent(sampled: Queries) -> None:
    x = coordinates(sampled, LevelMixture(0.6, 0.4))
    names = list(x)
    assert len(names) == 7
    pairs = [(a, b) for n, a in enumerate(names) for b in names[:n]]
    p = [uniformity(x[a], x[b]) for a, b in pairs]
    assert holm(p).min() > 1e-3, pairs[int(np.argmin(p))]


@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.0, 1.0), (0.6, 0.4), (1.0, 3.0)])
def test_levels_follow_the_mixture(weights: tuple[float, float]) -> None:
    mixture = LevelMixture(*weights)
    q = draw(mixture=mixture)
    cumulative = np.sort(coordinates(q, mixture)["level"])
    # Stratified along each part of the mixture: far closer than the scatter of random draws …
    assert np.abs(cumulative - (np.arange(ROWS) + 0.5) / ROWS).max() < 4 / ROWS
    # … so a part of the shard, in its order, is what a random draw would be.
    part = np.sort(coordinates(q, mixture)["level"][: ROWS // 64])
    n = len(part)
    distance = max(np.abs(part - np.arange(n) / n).max(), np.abs(part - np.arange(1, n + 1) / n).max())
    assert kolmogorov(distance * np.sqrt(n)) > 1e-3


def test_positions_are_uniform_within_their_texels(sampled: Queries) -> None:
    rows, columns = LATTICE.shape()
    inside = (sampled.u.astype(np.float64) * (columns, rows)) % 1.0
    assert uniformity(*inside.T) > 1e-3


def test_images_have_stratified_levels() -> None:
    lattice = Lattice(1, 1.0)
    q = draw("image", LevelMixture(1.0, 0.0), lattice)
    level = np.sort(level_of_sigma(q.sigma[:, 0, 0]))
    assert np.abs(level - (np.arange(ROWS) + 0.5) / ROWS).max() < 1.5 / ROWS

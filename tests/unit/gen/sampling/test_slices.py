"""Angular slices: their directions, and the queries of the slices layout."""

from __future__ import annotations

import numpy as np
import pytest
from support.datasets import write_dataset

from mbtf_core.data.lattice import Lattice
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan, direction_pairs, slice_directions


@pytest.mark.parametrize(("count", "min_cos"), [(1, 0.5), (20, 0.1), (151, 0.3)])
def test_the_spiral_covers_the_projected_disk_evenly(count: int, min_cos: float) -> None:
    omega = slice_directions("spiral", count, min_cos).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(omega, axis=1), 1.0, atol=1e-6)
    assert omega[:, 2].min() >= min_cos
    # One direction in each ring of equal area, and no half of the disk has many more than the other.
    area = (omega[:, 0] ** 2 + omega[:, 1] ** 2) / (1.0 - min_cos**2) * count
    np.testing.assert_allclose(area, np.arange(count) + 0.5, atol=1e-3)
    if count > 10:
        assert np.abs(omega[:, :2].mean(axis=0)).max() < 0.05


def test_the_measured_directions_are_those_of_bonn() -> None:
    """81 directions: every 15° from the normal, with 1, 6, 12, 18, 20 and 24 azimuths."""
    omega = slice_directions("ubo2003", 7, 0.1).astype(np.float64)
    angle = np.round(np.degrees(np.arccos(np.minimum(omega[:, 2], 1.0))), 2)
    assert [list(a) for a in np.unique(angle, return_counts=True)] == [
        [*range(0, 90, 15)],
        [1, 6, 12, 18, 20, 24],
    ]
    azimuth = np.degrees(np.arctan2(omega[:, 1], omega[:, 0])) % 360.0
    np.testing.assert_allclose(azimuth[angle == 60.0], 18.0 * np.arange(20), atol=1e-4)


@pytest.mark.parametrize("aspect", [1.0, 0.5])
def test_every_texel_has_one_slice_at_its_center(aspect: float) -> None:
    lattice = Lattice(3, aspect)
    directions = slice_directions("spiral", 4, 0.2)
    plan = QueryPlan(lattice, LevelMixture(1, 0), 0.2, "slices", 3, 10, None, directions)
    count = lattice.texels()
    shards = [plan.draw("train", s, min(10, count - 10 * s)) for s in range(-(-count // 10))]
    u = np.concatenate([q.u for q in shards])
    assert u.shape == (count, 16, 2)
    assert (u == u[:, :1]).all()
    rows, columns = lattice.shape()
    place = u[:, 0] * (columns, rows) - 0.5
    np.testing.assert_allclose(place, np.round(place), atol=1e-4)
    assert len(np.unique(np.round(place), axis=0)) == count
    light, view = direction_pairs(directions)
    for q in shards:
        assert (q.omega_i == light).all()
        assert (q.omega_o == view).all()
        np.testing.assert_allclose(q.sigma, 0.5 / 8)


def test_test_queries_are_those_of_the_shuffled_layout() -> None:
    directions = slice_directions("spiral", 4, 0.2)
    plan = QueryPlan(Lattice(3), LevelMixture(0.6, 0.4), 0.2, "slices", 3, 10, None, directions)
    shuffled = QueryPlan(Lattice(3), LevelMixture(0.6, 0.4), 0.2, "shuffled", 3, 10)
    for found, expected in zip(
        vars(plan.draw("test", 2, 10)).values(), vars(shuffled.draw("test", 2, 10)).values(), strict=True
    ):
        assert (found[:, 0] == expected).all()


def test_a_data_set_rounds_down_to_squares(tmp_path) -> None:  # type: ignore[no-untyped-def]
    queries = {"train": "11/texel", "test": "50", "layout": "slices", "resolution": 4}
    data = write_dataset(tmp_path / "shards", queries=queries)
    arrays = data.load("train")
    assert data.manifest["slice_size"] == 9
    assert data.manifest["splits"]["train"]["queries"] == 9 * data.lattice.texels()
    assert arrays["value_a"].shape == (data.lattice.texels(), 9, 3)
    assert data.load("test")["sigma"].shape == (50, 1)

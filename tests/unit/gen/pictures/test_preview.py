"""Previews without rendering: camera, block of tiles, samples of queries, plots, faults of drawing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.datasets import write_dataset

from mbtf_core.data.lattice import texel_centers
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job
from mbtf_gen.pictures.mesh import tiled_mesh
from mbtf_gen.pictures.query_plots import sampled_queries, stored_queries
from mbtf_gen.sampling.query_sampler import LevelMixture
from mbtf_gen.tile.heightfield_tile import HeightFieldTile


def material(rows: int = 4, columns: int = 8, **options: Any) -> HeightFieldTile:
    rng = np.random.default_rng(1)
    color = rng.uniform(0.1, 0.9, (rows, columns, 3)).astype(np.float32)
    return HeightFieldTile(0.1 * rng.random((rows, columns)), maps={"base_color": color, **options})


@pytest.mark.parametrize("tiles", [1, 2, 3])
def test_the_block_is_the_repeated_tile(tiles: int) -> None:
    m = material()
    block = tiled_mesh(m, tiles, 0.0)
    assert block.cells == (4, 8)
    assert block.points.shape == (4 * tiles + 1, 8 * tiles + 1, 3)
    z = m.height - m.height.max()
    centers = texel_centers(4, 8)
    # The last tile row is the map itself, at its texel centers; the first column continues it upwards.
    np.testing.assert_allclose(block.points[-5:-1, :8, 2], z, atol=1e-6)
    np.testing.assert_allclose(block.uv[-5:-1, :8], centers, atol=1e-6)
    np.testing.assert_allclose(block.points[..., 0], block.uv[..., 0], atol=1e-6)
    np.testing.assert_allclose(block.points[..., 1], 0.5 * block.uv[..., 1], atol=1e-6)
    np.testing.assert_allclose(block.points[:4, -9:-1, 2], z, atol=1e-6)
    assert not block.hole.any()
    # Brighter texels are shown brighter; row 0 stays on top.
    shown = block.texture.astype(float).mean(axis=-1).ravel()
    assert np.corrcoef(shown, np.asarray(m.maps["base_color"]).mean(axis=-1).ravel())[0, 1] > 0.95


def test_holes_are_cut_where_little_is_left() -> None:
    opacity = np.ones((4, 8), np.float32)
    opacity[1:3, 2:6] = 0.0
    block = tiled_mesh(material(opacity=opacity), 2, 0.0)
    assert block.hole.shape == (8, 16)
    # Cells lie between texel centers: those whose four corners average below one half.
    expected = np.zeros((4, 8), bool)
    expected[1:2, 2:5] = True
    np.testing.assert_array_equal(block.hole, np.tile(expected, (2, 2)))
    assert tiled_mesh(material(opacity=0.2), 1, 0.0).hole.all()


@pytest.mark.parametrize("layout", ["shuffled", "image"])
def test_stored_queries_are_those_that_the_configuration_samples(layout: str, tmp_path: Path) -> None:
    queries = {"train": "100", "test": "8", "layout": layout}
    dataset = write_dataset(tmp_path / "set", queries=queries, output={"shard_queries": 40})
    config = GeneratorConfig.model_validate(dataset.manifest["config"])
    a, b = stored_queries(dataset), sampled_queries(Job.load(config))
    data = dataset.load("train")
    for sample in (a, b):
        for name, axes in (("u", 2), ("sigma", 1), ("omega_i", 2), ("omega_o", 2)):
            expected = data[name].reshape(-1, *data[name].shape[data[name].ndim + 1 - axes :])
            np.testing.assert_array_equal(getattr(sample.queries, name), expected)
        assert sample.total == sample.level.size
        assert (sample.mixture, sample.finest) == (LevelMixture(0.6, 0.4), 3)
        assert (sample.min_cos, sample.aspect) == (0.1, 0.5)

"""Previews without rendering: camera, block of tiles, samples of queries, plots, faults of drawing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.datasets import write_dataset

from mbtf_core.data.lattice import texel_centers
from mbtf_core.directions import from_angles
from mbtf_core.errors import InputError
from mbtf_core.pictures import Camera
from mbtf_core.run.processes import run_child
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job
from mbtf_gen.pictures import mesh
from mbtf_gen.pictures.mesh import draw, tiled_mesh
from mbtf_gen.pictures.query_plots import QuerySample, level_histogram, sampled_queries, stored_queries
from mbtf_gen.sampling.query_sampler import LevelMixture
from mbtf_gen.tile.heightfield_tile import HeightFieldTile

LIGHT = from_angles(35, 150)


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
    assert block.uv.max() == pytest.approx(tiles + 0.0625, abs=0.07)
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


def sample_of(count: int, seed: int = 0, **options: Any) -> QuerySample:
    config = GeneratorConfig.model_validate({"material": "m", "queries": {"train": str(count), **options}})
    job = Job.of(config, material())
    return sampled_queries(job)


def test_the_histogram_of_levels_follows_the_mixture() -> None:
    edges, found, stated = level_histogram(sample_of(20_000))
    assert edges[0] == 0
    assert edges[-1] == 3
    assert np.sum(found * np.diff(edges)) == pytest.approx(1.0)
    # Levels are stratified: the counts are those stated to within one per bin, or two at a weight's edge.
    np.testing.assert_allclose(found, stated, atol=2 / (20_000 * 0.125))
    other = replace(sample_of(20_000), mixture=LevelMixture(1.0, 0.0))
    assert np.abs(level_histogram(other)[1] - level_histogram(other)[2]).max() > 0.1
    # Few queries fill whole levels only.
    edges, found, stated = level_histogram(sample_of(300))
    assert edges.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(stated, [0.2, 0.2, 0.6])
    np.testing.assert_allclose(found, stated, atol=2 / 300)
    edges, found, stated = level_histogram(sample_of(50, resolution=1))
    assert (found.tolist(), stated.tolist()) == ([1.0], [1.0])


@pytest.mark.parametrize("layout", ["shuffled", "image"])
def test_stored_queries_are_those_that_the_configuration_samples(layout: str, tmp_path: Path) -> None:
    dataset = write_dataset(
        tmp_path / "set",
        queries={"train": "100", "test": "8", "layout": layout},
        output={"shard_queries": 40},
    )
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


def test_unfinished_shards_are_left_out(tmp_path: Path) -> None:
    dataset = write_dataset(
        tmp_path / "set", queries={"train": "100", "test": "8"}, output={"shard_queries": 40}
    )
    (tmp_path / "set/train-00001.json").unlink()
    finished = dataset.shards("train", finished_only=True)
    assert [shard.file for shard in finished] == ["train-00000.npz", "train-00002.npz"]
    sample = stored_queries(dataset)
    assert (sample.level.size, sample.total) == (60, 100)
    for name in ("train-00000.npz", "train-00002.npz"):
        (tmp_path / "set" / name).unlink()
    with pytest.raises(InputError, match="no finished train shard"):
        stored_queries(dataset)


def test_a_crash_while_drawing_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def crashing(module: str, function: str, *arguments: str, timeout: float) -> Any:
        return run_child("support.crashing", "crash", *arguments, timeout=timeout)

    monkeypatch.setattr(mesh, "run_child", crashing)
    block, camera = tiled_mesh(material(), 1, 0.0), Camera(rows=8, columns=8)
    fault = draw(block, camera, LIGHT, tmp_path / "mesh.png")
    assert fault == "the process was ended by SIGSEGV"
    assert list(tmp_path.iterdir()) == []

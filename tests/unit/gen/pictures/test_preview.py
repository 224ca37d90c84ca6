"""Previews without rendering: holes of the mesh, and the queries that are shown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.datasets import write_dataset

from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job
from mbtf_gen.pictures.mesh import tiled_mesh
from mbtf_gen.pictures.query_plots import first_queries
from mbtf_gen.tile.heightfield_tile import HeightFieldTile


def material(rows: int = 4, columns: int = 8, **options: Any) -> HeightFieldTile:
    rng = np.random.default_rng(1)
    color = rng.uniform(0.1, 0.9, (rows, columns, 3)).astype(np.float32)
    return HeightFieldTile(0.1 * rng.random((rows, columns)), maps={"base_color": color, **options})


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
def test_the_queries_shown_are_those_of_the_data_set(layout: str, tmp_path: Path) -> None:
    queries = {"train": "100", "test": "8", "layout": layout}
    data = write_dataset(tmp_path / "set", queries=queries, output={"shard_queries": 40})
    found = first_queries(Job.load(GeneratorConfig.model_validate(data.manifest["config"])))
    for name, stored in data.load("train").items():
        if hasattr(found, name):
            shown = getattr(found, name)
            np.testing.assert_array_equal(shown, stored.reshape(-1, *shown.shape[1:]))

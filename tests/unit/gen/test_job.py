"""Jobs: shards, queries and paths that follow from a configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbtf_core.errors import InputError
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job, most_paths, planned_paths, planned_work, query_work, split_queries


@pytest.fixture
def heights(tmp_path: Path) -> Path:
    np.save(tmp_path / "height.npy", np.random.default_rng(0).random((4, 8)))
    return tmp_path / "height.npy"


def job_of(heights: Path, **queries: Any) -> Job:
    """A job of 100 training and 30 test queries on 4 x 8 texels, in shards of 40 queries."""
    options = {"train": "100", "test": "30", "spp": 2, "test_spp": 4, **queries}
    config = {"material": str(heights), "queries": options, "output": {"shard_queries": 40}}
    return Job.load(GeneratorConfig.model_validate(config))


def rows(job: Job, split: str = "train") -> list[tuple[str, int]]:
    return [(entry.file, entry.rows) for entry in job.shards if entry.split == split]


def test_shards_cover_the_rows(heights: Path) -> None:
    job = job_of(heights)
    assert rows(job) == [(f"train-{i:05d}.npz", n) for i, n in enumerate((40, 40, 20))]
    assert rows(job, "test") == [("test-00000.npz", 30)]
    # Image layout: whole images of 32 texels; 100 queries are four of them, one per shard.
    assert [n for _, n in rows(job_of(heights, layout="image"))] == [1] * 4
    # Patches of 9 texels: 100 queries are twelve of them, four per shard of 40 queries.
    patches = job_of(heights, layout="image", patch_size=3)
    assert [n for _, n in rows(patches)] == [4, 4, 4]
    assert split_queries(patches, "train") == 108
    assert sum(n for _, n in rows(job_of(heights, train="3/texel"))) == 96


def test_the_limit_of_the_displacement_range_can_be_raised(tmp_path: Path) -> None:
    np.save(tmp_path / "tall.npy", np.linspace(0.0, 200.0, 32).reshape(4, 8))

    def config(**geometry: float) -> GeneratorConfig:
        return GeneratorConfig.model_validate({"material": str(tmp_path / "tall.npy"), "geometry": geometry})

    with pytest.raises(InputError, match=r"200 tile widths; at most 100"):
        Job.load(config(height_scale=1.0)).announce()
    raised = Job.load(config(height_scale=1.0, max_displacement=300.0))
    assert raised.material.thickness == 200.0
    assert Job.load(config(height_scale=0.4)).material.thickness == 80.0
    # The limit does not change the data.
    assert raised.config_hash == Job.of(config(height_scale=1.0), raised.material).config_hash


def test_lights_of_a_path_share_it_in_whole_groups(heights: Path) -> None:
    job = job_of(heights, lights_per_path=3)
    # 100 queries are 34 groups, 13 of them per shard of 40 queries.
    assert [n for _, n in rows(job)] == [39, 39, 24]
    assert rows(job, "test") == [("test-00000.npz", 30)]
    assert split_queries(job, "train") == 102
    assert planned_paths(job, job.shards) == most_paths(job) == 34 * 2 + 30 * 4
    # A vertex has four rays instead of two.
    assert planned_work(job, job.shards) == 34 * 2 * 2 + 30 * 4
    assert query_work(job) == pytest.approx(2 * 2 / 3)
    # Groups that do not fit into a shard make larger shards.
    assert [n for _, n in rows(job_of(heights, lights_per_path=64))] == [64, 64]

"""Previews without rendering: the queries that are shown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.datasets import write_dataset

from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job
from mbtf_gen.pictures.query_plots import first_queries


@pytest.mark.parametrize("layout", ["shuffled", "image"])
def test_the_queries_shown_are_those_of_the_data_set(layout: str, tmp_path: Path) -> None:
    queries = {"train": "100", "test": "8", "layout": layout}
    data = write_dataset(tmp_path / "set", queries=queries, output={"shard_queries": 40})
    found = first_queries(Job.load(GeneratorConfig.model_validate(data.manifest["config"])))
    for name, stored in data.load("train").items():
        if hasattr(found, name):
            shown = getattr(found, name)
            np.testing.assert_array_equal(shown, stored.reshape(-1, *shown.shape[1:]))

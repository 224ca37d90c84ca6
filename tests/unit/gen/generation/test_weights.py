"""Weights of test queries: from the sampler to files, and back to their readers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.datasets import write_dataset

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.verify import verify
from mbtf_fit import QueryDataset
from mbtf_fit.data.loader import load_split
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.evaluation import split_errors
from mbtf_gen.generation.folder import read_run_plan
from mbtf_gen.planning.highlights import Highlights

# Bright towards low lights.
SHARE = 0.5
HIGHLIGHTS = Highlights((0.0, 0.0, -1.0, *[0.0] * 52), SHARE)


def write(folder: Path, layout: str = "shuffled", suffix: str = "npz", **options: Any) -> Dataset:
    queries = {"train": "64", "test": "96", "resolution": 4, "layout": layout}
    if layout == "slices":
        queries |= {"train": "64/texel", "test": "16"}
    output = {"shard_queries": 64, "format": suffix}
    return write_dataset(folder, rows=4, columns=4, queries=queries, output=output, **options)


@pytest.mark.parametrize("layout", ["shuffled", "image", "slices"])
@pytest.mark.parametrize("suffix", ["npz", "exr"])
def test_files_hold_the_weights_of_test_queries(tmp_path: Path, layout: str, suffix: str) -> None:
    data = write(tmp_path / "shards", layout, suffix, highlights=HIGHLIGHTS)
    test, train = data.load("test"), data.load("train")
    assert data.weighted
    assert "weight" not in train
    assert test["weight"].shape == test["sigma"].shape
    assert 0 < test["weight"].min() <= test["weight"].max() <= 1 / (1 - SHARE)
    # Low lights are drawn more often.
    assert np.corrcoef(test["weight"].ravel(), test["omega_i"][..., 2].ravel())[0, 1] > 0.3
    assert read_run_plan(data.folder).highlights == HIGHLIGHTS
    assert not verify(data.folder)
    flat = load_split(data, "test")
    np.testing.assert_array_equal(flat.weight, test["weight"].ravel())
    batches = list(QueryDataset(tmp_path / "shards", "test", batch_size=10))
    found = np.concatenate([np.stack([b.weight, b.sigma], 1) for b in batches])
    stored = np.stack([flat.weight, flat.sigma], 1)
    np.testing.assert_array_equal(found[np.lexsort(found.T)], stored[np.lexsort(stored.T)])


def test_without_highlights_nothing_changes(tmp_path: Path) -> None:
    plain = write(tmp_path / "plain")
    drawn = write(tmp_path / "drawn", highlights=HIGHLIGHTS)
    assert not plain.weighted
    assert "weight" not in plain.load("test")
    for first, second in zip(plain.shards("train"), drawn.shards("train"), strict=True):
        assert first.sidecar["sha256"] == second.sidecar["sha256"]


def test_errors_of_a_fit_use_the_weights(tmp_path: Path) -> None:
    """A query of the weight 2 counts as two queries."""
    data = write(tmp_path / "shards", highlights=HIGHLIGHTS)
    stored = load_split(data, "test")
    level = stored.value_a.mean(1)
    weight = 1 + np.digitize(level, np.quantile(level, (0.5, 0.75, 0.9))).astype(np.float32)
    arrays = vars(stored) | {"weight": weight}
    weighted, repeated = ShardQueries(**arrays), ShardQueries(**(arrays | {"weight": None}))
    repeated = repeated.take(np.repeat(np.arange(len(stored)), weight.astype(int)))

    def predict(queries: ShardQueries) -> Any:
        return 0.3 * queries.omega_i[:, 2:] + np.zeros(3, np.float32)

    found, expected = (split_errors(predict, queries, data) for queries in (weighted, repeated))
    assert found["mse"]["value"] == pytest.approx(expected["mse"]["value"])
    assert found["exposure"] == pytest.approx(expected["exposure"], abs=0.02)
    for group in ("levels", "elevations"):
        for name, errors in found[group].items():
            assert errors["mse"]["value"] == pytest.approx(expected[group][name]["mse"]["value"])
    assert found["unexplained"]["value"] == pytest.approx(expected["unexplained"]["value"], rel=0.05)

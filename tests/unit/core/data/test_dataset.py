"""Data sets as folders: opening, splits, both layouts, both formats, and folders that are none."""

from __future__ import annotations

import re
import runpy
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.datasets import FOREIGN, NOISE, formula, rewrite, write_dataset
from support.paths import ROOT

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.schema import Queries
from mbtf_core.data.shard_files import read_shard
from mbtf_core.errors import InputError
from mbtf_core.stats import pooled_error

OUTPUT = {"shard_queries": 64}


@pytest.mark.parametrize("array_format", ["npz", "exr"])
def test_shuffled_layout(tmp_path: Path, array_format: str) -> None:
    written = {"train": "150", "test": "1000"}
    data = write_dataset(tmp_path / "shards", queries=written, output={**OUTPUT, "format": array_format})
    assert data.layout == "shuffled"
    assert data.splits == ["train", "test"]
    assert [s.rows for s in data.shards("train")] == [64, 64, 22]
    assert [s.file for s in data.shards("train")] == [f"train-{i:05d}.{array_format}" for i in range(3)]
    arrays = data.load("train")
    assert {a.shape[0] for a in arrays.values()} == {150}
    test = data.load("test")
    queries = Queries(test["u"], test["sigma"], test["omega_i"], test["omega_o"])
    error = (test["value_a"] + test["value_b"]) / 2 - formula(queries)
    expected = pooled_error(test["value_a"], test["value_b"]).value
    assert np.sqrt(np.mean(error**2)) == pytest.approx(expected, rel=0.1)
    assert np.abs(error).max() < 6 * NOISE


@pytest.mark.parametrize("layout", ["shuffled", "image"])
def test_the_reader_of_the_documentation_reads_what_is_written(tmp_path: Path, layout: str) -> None:
    queries = {"train": "160", "test": "64", "layout": layout}
    data = write_dataset(tmp_path / "shards", queries=queries, output=OUTPUT)
    read_split = runpy.run_path(str(ROOT / "examples/read_data.py"))["read_split"]
    for split in ("train", "test"):
        expected, found = data.load(split), read_split(str(data.folder), split)
        assert set(found) == set(expected)
        assert all(np.array_equal(found[name], expected[name]) for name in expected)


def test_the_documentation_explains_every_key(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "shards", queries={"train": "160", "test": "64"}, output=OUTPUT)
    page = (ROOT / "docs/reference/data-format.md").read_text(encoding="utf-8")
    manifest, sidecar = data.manifest, data.shards("train")[0].sidecar
    split, levels, effects = manifest["splits"]["train"], manifest["levels"], manifest["effects"]
    parts = [manifest[name] for name in ("tile", "geometry", "summary")]
    parts += [split, split["shards"][0], levels, levels["mixture"], effects, effects["effects"][0]]
    parts += [manifest["arrays"]["u"], sidecar["seed"], sidecar["statistics"]]
    _, of_manifest, of_sidecar = re.split(r"^## (?:Manifest|Sidecar)$", page, flags=re.M)
    assert [key for part in (manifest, *parts) for key in part if f"`{key}`" not in page] == []
    assert [key for key in manifest if f"`{key}`" not in of_manifest] == []
    assert [key for key in (*sidecar, *sidecar["quarantined"]) if f"`{key}`" not in of_sidecar] == []


@pytest.mark.parametrize("suffix", ["npz", "json"])
def test_missing_and_unfinished_shards(tmp_path: Path, suffix: str) -> None:
    data = write_dataset(tmp_path / "shards", queries={"train": "100", "test": "10"}, output=OUTPUT)
    data.folder.delete(f"train-00001.{suffix}")
    with pytest.raises(InputError, match=r"train-00001\.npz is missing or unfinished") as caught:
        data.load("train")
    assert "resumes" in caught.value.hint
    assert len(data.load("test")["u"]) == 10
    with pytest.raises(InputError, match=r"no split 'valid' \(it has: train, test\)"):
        data.shards("valid")


def test_folders_that_hold_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        Dataset.open(tmp_path / "gone")
    with pytest.raises(InputError, match=r"no manifest\.json"):
        Dataset.open(tmp_path)
    path = tmp_path / "manifest.json"
    for text, message in (
        ("{", "not readable as JSON"),
        ('{"format": "other"}', "is not a manifest"),
        ('{"format": "mbtf-shards", "schema": 99}', "schema version 99, this program reads version 6"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            Dataset.open(tmp_path)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Data sets of two layouts and formats, and beside each the same of another seed."""
    folder = tmp_path_factory.mktemp("runs")
    for layout in ("shuffled", "image"):
        for suffix in ("npz", "exr"):
            for seed in (0, 1):
                write_dataset(
                    folder / f"{layout}-{suffix}-{seed}",
                    queries={"train": "128", "test": "32", "layout": layout},
                    output={"shard_queries": 64, "format": suffix},
                    seed=seed,
                )
    return {name: folder / f"{name}-0" for name in ("shuffled-npz", "shuffled-exr", "image-npz", "image-exr")}


@pytest.mark.parametrize("kind", ["shuffled-npz", "shuffled-exr", "image-npz", "image-exr"])
@pytest.mark.parametrize("name", FOREIGN)
def test_foreign_and_impossible_data_are_refused(
    name: str, kind: str, runs: dict[str, Path], tmp_path: Path
) -> None:
    shutil.copytree(runs[kind], tmp_path / "set")
    other = runs[kind].with_name(f"{kind}-1")
    change, says = FOREIGN[name]
    change(tmp_path / "set", other, f".{kind[-3:]}")
    with pytest.raises(InputError, match=says):
        Dataset.open(tmp_path / "set").load("train")
    with pytest.raises(InputError, match=says):
        list(Dataset.open(tmp_path / "set").iterate("train"))


def test_images_have_one_direction_and_the_size_of_the_lattice(runs: dict[str, Path], tmp_path: Path) -> None:
    shard = tmp_path / "set/train-00001.npz"

    def found(**arrays: Any) -> str:
        shutil.copytree(runs["image-npz"], tmp_path / "set", dirs_exist_ok=True)
        rewrite(shard, **arrays)
        with pytest.raises(InputError) as caught:
            Dataset.open(tmp_path / "set").load("train")
        return caught.value.what

    intact = {n: np.array(a) for n, a in read_shard(runs["image-npz"] / shard.name).items()}
    sigma = intact["sigma"].copy()
    sigma[1, 2, 3] *= 0.5
    assert found(sigma=sigma) == "'sigma' differs between texels of an image"
    flat = {name: array[:, 0, 0] for name, array in intact.items()}
    assert found(**flat) == "has 1 queries per row, manifest.json says 4 x 8"

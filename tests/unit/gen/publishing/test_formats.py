"""Published files hold the numbers of the shards: read by pyarrow, WebDataset and NumPy."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
from support.published import LAYOUTS, contents, publish, small, stored

from mbtf_core.data.schema import ARRAY
from mbtf_core.data.verify import verify
from mbtf_gen.publishing.formats import write_tar

pq = pytest.importorskip("pyarrow.parquet")
webdataset = pytest.importorskip("webdataset")


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("formats")
    for layout in LAYOUTS:
        small(folder / layout, layout)
    return folder


@pytest.mark.parametrize("layout", LAYOUTS)
def test_parquet_holds_the_same_numbers(layout: str, work: Path, tmp_path: Path) -> None:
    card = publish(work / layout, tmp_path / "card")
    assert len(list((card / "data").glob("train-*.parquet"))) >= 2
    for split in ("train", "test"):
        arrays = stored(work / layout, split)
        table = pq.read_table(sorted((card / "data").glob(f"{split}-*.parquet")))
        assert table.column_names == list(arrays)
        for name, array in arrays.items():
            field = table.schema.field(name)
            assert field.metadata[b"unit"].decode() == ARRAY[name].unit
            assert tuple(json.loads(field.metadata[b"shape"])) == (-1, *array.shape[1:])
            found = np.array(table[name].to_pylist(), np.float32)
            assert found.shape == array.shape
            assert found.tobytes() == array.tobytes()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_webdataset_reads_the_same_numbers(layout: str, work: Path, tmp_path: Path) -> None:
    card = publish(work / layout, tmp_path / "card", form="webdataset")
    paths = [str(path) for path in sorted((card / "data").glob("train-*.tar"))]
    samples = list(webdataset.WebDataset(paths, shardshuffle=False).decode())
    arrays = stored(work / layout, "train")
    for name, array in arrays.items():
        assert np.concatenate([sample[f"{name}.npy"] for sample in samples]).tobytes() == array.tobytes()
    with tarfile.open(paths[0]) as tar:
        for member in tar:
            assert (member.mtime, member.uid, member.uname, member.mode) == (0, 0, "", 0o644)


def test_samples_of_tar_files_are_blocks_of_rows(tmp_path: Path) -> None:
    rows = 200_000
    arrays = {"sigma": np.arange(rows, dtype=np.float32), "u": np.ones((rows, 2), np.float32)}
    write_tar(tmp_path / "train-00000.tar", arrays)
    with tarfile.open(tmp_path / "train-00000.tar") as tar:
        names = tar.getnames()
        sizes = [member.size for member in tar]
    assert names[:3] == [
        "train-00000-000000.sigma.npy",
        "train-00000-000000.u.npy",
        "train-00000-000001.sigma.npy",
    ]
    assert len(names) == 6
    assert max(a + b for a, b in zip(sizes[::2], sizes[1::2], strict=True)) < 1.01 * 2**20
    # An archive is whole records of 10 240 bytes.
    assert (tmp_path / "train-00000.tar").stat().st_size % 10_240 == 0


def test_shards_are_published_as_they_are(work: Path, tmp_path: Path) -> None:
    card = publish(work / "shuffled", tmp_path / "card", form="npz")
    assert verify(card / "data") == []
    mine, theirs = contents(work / "shuffled"), contents(card / "data")
    assert set(mine) == set(theirs)
    changed = {name for name in mine if mine[name] != theirs[name]}
    assert changed == {"manifest.json", "config.yaml"}
    # Nobody learns where the author keeps the material.
    for content in contents(card).values():
        assert str(work).encode() not in content


def test_links_do_not_change_with_the_data_set(tmp_path: Path) -> None:
    small(tmp_path / "data")
    card = publish(tmp_path / "data", tmp_path / "card", form="npz")
    before = contents(card)
    (tmp_path / "data/train-00000.npz").unlink()
    (tmp_path / "data/train-00000.npz").write_bytes(b"other")
    assert contents(card) == before

"""Published files hold the numbers of the shards: read by pyarrow and NumPy."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.published import LAYOUTS, contents, publish, small, stored

from mbtf_core.data.schema import ARRAY
from mbtf_core.data.verify import verify

pq = pytest.importorskip("pyarrow.parquet")


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

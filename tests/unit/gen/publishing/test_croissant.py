"""``croissant.json`` is valid, and its reader finds the records of the shards."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.published import LAYOUTS, publish, small, stored

mlcroissant = pytest.importorskip("mlcroissant")


def opened(card: Path) -> Any:
    return mlcroissant.Dataset(jsonld=str(card / "croissant.json"))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_records_are_those_of_the_shards(layout: str, tmp_path: Path) -> None:
    small(tmp_path / layout, layout)
    card = publish(tmp_path / layout, tmp_path / "card")
    dataset = opened(card)
    assert dataset.metadata.ctx.issues.errors == set()
    assert {str(r.uuid) for r in dataset.metadata.record_sets} == {"train", "test"}
    for record_set in dataset.metadata.record_sets:
        arrays = stored(tmp_path / layout, record_set.uuid)
        records = list(dataset.records(record_set.uuid))
        assert len(records) == len(arrays["sigma"])
        for field in record_set.fields:
            array = arrays[field.name]
            assert field.data_type == np.float32
            assert (field.array_shape_tuple or ()) == array.shape[1:]
            assert field.description
            found = np.array([record[field.id] for record in records], np.float32)
            assert found.shape == array.shape
            assert found.tobytes() == array.tobytes()


def test_files_have_their_digests(tmp_path: Path) -> None:
    small(tmp_path / "data")
    card = publish(tmp_path / "data", tmp_path / "card")
    files = {f.content_url: f for f in opened(card).metadata.file_objects}
    assert {"data/train-00000.parquet", "data/geometry.exr", "recipe/config.yaml"} <= set(files)
    for name, file in files.items():
        content = (card / name).read_bytes()
        assert file.sha256 == hashlib.sha256(content).hexdigest()
        assert file.content_size == f"{len(content)} B"

"""The published folder: the same bytes twice, resumed, refused, replaced; readers of ``croissant.json``."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.datasets import flip
from support.published import LAYOUTS, contents, publish, small, stored

from mbtf_core.data.verify import verify
from mbtf_core.errors import InputError
from mbtf_gen.config.exchange import PublishConfig
from mbtf_gen.publishing.publication import Publication


@pytest.fixture
def shards(tmp_path: Path) -> Path:
    small(tmp_path / "data")
    return tmp_path / "data"


@pytest.mark.parametrize("form", ["parquet", "npz"])
def test_the_same_command_gives_the_same_bytes(form: str, shards: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    first, second = (publish(shards, tmp_path / name, form=form) for name in ("a", "b"))
    assert contents(first) == contents(second)


def test_damage_is_found_before_anything_is_written(shards: Path, tmp_path: Path) -> None:
    flip(shards / "train-00001.npz", -200)
    with pytest.raises(InputError, match=r"train-00001\.npz: has changed since it was written"):
        publish(shards, tmp_path / "card", form="parquet")
    assert not (tmp_path / "card").exists()


def test_shards_are_published_as_they_are(shards: Path, tmp_path: Path) -> None:
    card = publish(shards, tmp_path / "card", form="npz")
    assert verify(card / "data") == []
    mine, theirs = contents(shards), contents(card / "data")
    assert set(mine) == set(theirs)
    changed = {name for name in mine if mine[name] != theirs[name]}
    assert changed == {"manifest.json", "config.yaml"}
    # Nobody learns where the author keeps the material.
    for content in contents(card).values():
        assert str(tmp_path).encode() not in content


def test_links_do_not_change_with_the_data_set(tmp_path: Path) -> None:
    small(tmp_path / "data")
    card = publish(tmp_path / "data", tmp_path / "card", form="npz")
    before = contents(card)
    (tmp_path / "data/train-00000.npz").unlink()
    (tmp_path / "data/train-00000.npz").write_bytes(b"other")
    assert contents(card) == before


def test_other_options_are_refused_and_replace(shards: Path, tmp_path: Path) -> None:
    card = publish(shards, tmp_path / "card", form="parquet")
    (card / "mine.txt").write_text("kept")
    before = contents(card)
    with pytest.raises(InputError, match=r"another configuration: license: CC0-1\.0 -> CC-BY-4\.0"):
        publish(shards, card, form="parquet", license="CC-BY-4.0")
    assert contents(card) == before
    config = PublishConfig(license="CC-BY-4.0", form="npz")
    Publication.prepare(shards, config).write(card, overwrite=True)
    assert not list(card.rglob("*.parquet"))
    assert (card / "mine.txt").read_text() == "kept"
    assert "CC-BY-4.0" in (card / "README.md").read_text()


def opened(card: Path) -> Any:
    return pytest.importorskip("mlcroissant").Dataset(jsonld=str(card / "croissant.json"))


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

"""Damaged data sets: they load, or are refused in a line or two; no other exception, whatever is damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.datasets import edit, write_dataset
from support.fuzzing import altered, damaged, loads_or_refuses

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.schema import MANIFEST_NAME
from mbtf_core.data.shard_files import read_shard, write_exr, write_npz
from mbtf_core.data.verify import verify
from mbtf_core.errors import InputError
from mbtf_fit.data.loader import load_split, load_training
from mbtf_fit.sections import HeldOutSection
from mbtf_fit.training.suitable_data import open_data
from mbtf_gen.generation.manifest import finish

TRAILING = {"u": 2, "omega_i": 3, "omega_o": 3, "value_a": 3, "value_b": 3}
ARRAYS = {name: np.ones((3, size), np.float32) for name, size in TRAILING.items()}
ARRAYS |= {name: np.ones(3, np.float32) for name in ("sigma", "spp")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Room for one damaged file at a time."""
    return tmp_path_factory.mktemp("shards")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of three shards."""
    made = tmp_path_factory.mktemp("set") / "set"
    write_dataset(made, queries={"train": "20", "test": "4"}, output={"shard_queries": 10})
    manifest = made / MANIFEST_NAME
    # The same bytes in every run, wherever the folder lies.
    edit(manifest, lambda document: document["config"].update(material="of/set.npy"))
    return made


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    made = tmp_path_factory.mktemp("samples")
    write_npz(made / "a.npz", ARRAYS)
    write_exr(made / "a.exr", ARRAYS)
    # Another writer's archive: sizes without zip64, no padding.
    np.savez(made / "b.npz", **ARRAYS)
    return {path.name: path.read_bytes() for path in made.iterdir()}


@given(data=st.data())
@settings(max_examples=250)
def test_a_damaged_shard(data: st.DataObject, samples: dict[str, bytes], folder: Path) -> None:
    name, content = data.draw(damaged(samples))
    path = folder / name
    path.write_bytes(content)
    for mapped in (True, False):
        arrays = loads_or_refuses(lambda mapped=mapped: read_shard(path, mapped=mapped))
        if arrays:
            # What is loaded can be read to its end: nothing is mapped beyond the file.
            assert all(np.isfinite(a).size == a.size for a in arrays.values())
            assert sum(a.nbytes for a in arrays.values()) <= len(content)


def read_all(folder: Path) -> None:
    """What the programs do with a data set."""
    for read in (
        lambda: verify(folder),
        lambda: Dataset.open(folder).lattice,
        lambda: Dataset.open(folder).load("train"),
        lambda: load_training(open_data(folder, "neumip"), HeldOutSection(), 0),
        lambda: load_split(open_data(folder, "neumip"), "test"),
        lambda: finish(folder),
    ):
        loads_or_refuses(read)


@given(data=st.data())
@settings(max_examples=150)
def test_an_altered_manifest_or_sidecar(data: st.DataObject, whole: Path) -> None:
    manifest = (whole / MANIFEST_NAME).read_text()
    path = whole / data.draw(st.sampled_from([MANIFEST_NAME, MANIFEST_NAME, "train-00001.json"]))
    before = path.read_text()
    try:
        path.write_text(data.draw(altered(before)))
        read_all(whole)
    finally:
        path.write_text(before)
        # Reading may have completed it.
        (whole / MANIFEST_NAME).write_text(manifest)


def test_a_manifest_cannot_name_files_elsewhere(whole: Path) -> None:
    manifest = whole / MANIFEST_NAME
    before = manifest.read_text()
    edit(manifest, lambda m: m["splits"]["train"]["shards"][1].update(file="../outside.npz"))
    with pytest.raises(InputError, match=r"splits\.train\.shards\.1\.file"):
        Dataset.open(whole)
    manifest.write_text(before)

"""Damaged measured BTFs from file to data set: imported, or refused in one or two lines."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import measured_files as files
from support.fuzzing import damaged, loads_or_refuses

from mbtf_core.data.dataset import Dataset
from mbtf_gen.config.exchange import ImportConfig
from mbtf_gen.generation.imported import Import, import_measured

CONFIG = ImportConfig.model_validate(
    {"queries": {"train": "60", "test": "20", "min_cos": 0.05}, "cosine": "included"}
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("imports")


@pytest.fixture(scope="module")
def samples(folder: Path) -> dict[str, bytes]:
    random = np.random.default_rng(0)
    shape = (2, 6, 8)
    queries = {
        "ground_color": random.random((*shape, 3)),
        "ground_camera_target_loc": random.uniform(-1, 1, (*shape, 2)),
        "ground_camera_query_radius": 0.5 ** random.uniform(1, 5, (*shape, 1)),
        "ground_camera_dir": random.uniform(-0.6, 0.6, (*shape, 2)),
        "ground_light": random.uniform(-0.6, 0.6, (*shape, 2)),
    }
    half = {name: array.astype(np.float16) for name, array in queries.items()}
    photographs = dict(list(files.photographs().items())[:3])
    return {
        "btf": files.btf(9, 2),
        "zip": files.zipped(photographs),
        "neumip": files.write_hdf5(folder / "a", half, base_radius=1 / 32).read_bytes(),
    }


def imported(content: bytes, folder: Path) -> Dataset:
    (folder / "file").write_bytes(content)
    shutil.rmtree(folder / "shards", ignore_errors=True)
    import_measured(Import.prepare(folder / "file", CONFIG), folder / "shards")
    return Dataset.open(folder / "shards")


@pytest.mark.parametrize("name", ["btf", "zip", "neumip"])
def test_sound_files_are_imported(name: str, samples: dict[str, bytes], folder: Path) -> None:
    assert len(imported(samples[name], folder).load("train")["sigma"]) > 20


@given(data=st.data())
@settings(max_examples=120)
def test_damaged_files(data: st.DataObject, samples: dict[str, bytes], folder: Path) -> None:
    _, content = data.draw(damaged(samples))
    found = loads_or_refuses(lambda: imported(content, folder))
    if found is not None:
        for split in found.splits:
            if found.shards(split):
                found.load(split)

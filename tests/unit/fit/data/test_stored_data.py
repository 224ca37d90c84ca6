"""Fits to data in an object store: equal bits, a bounded cache."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import pytest
from support.fit_data import parallax, write_data
from support.object_stores import memory_store

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.store import ObjectStore
from mbtf_core.errors import PartialError
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import load_training
from mbtf_fit.data.streaming import StreamedQueries
from mbtf_fit.sections import HeldOutSection
from mbtf_fit.training.fit import fit
from mbtf_fit.training.loop import CHECKPOINT_NAME

HELD_OUT = HeldOutSection(queries=0.1, radius=0.3)


@pytest.fixture
def url(tmp_path: Path) -> Iterator[str]:
    with memory_store(tmp_path / "cache") as found:
        yield found


@pytest.fixture
def local(tmp_path: Path, url: str) -> Path:
    """A data set of eight shards, and the same one in the store."""
    folder = write_data(tmp_path / "local", parallax, train=8000, test=500, shards=8)
    store = ObjectStore(url)
    for path in folder.iterdir():
        store.write(path.name, path.read_bytes())
    return folder


@pytest.fixture
def downloads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The shard of every download."""
    found: list[str] = []
    original = ObjectStore.read

    def watched(self: ObjectStore, name: str) -> bytes:
        if name.endswith(".npz"):
            found.append(name)
        return original(self, name)

    monkeypatch.setattr(ObjectStore, "read", watched)
    return found


def cached(folder: Path) -> int:
    found = 0
    for path in (folder / "cache/mbtf/stores/shards").iterdir():
        # The thread that reads the next batch makes room meanwhile.
        with contextlib.suppress(FileNotFoundError):
            found += path.stat().st_size
    return found


@pytest.mark.parametrize("memory", ["1GB", "1kB"])
@pytest.mark.parametrize("cache", ["20GB", "1kB"])
def test_a_fit_is_identical(tmp_path: Path, url: str, local: Path, memory: str, cache: str) -> None:
    options = {"training": {"steps": 6, "batch": 500}, "data": {"memory": memory, "cache": cache}}
    config = FitConfig.model_validate(options)
    mine = fit(config, local, tmp_path / "mine").material.model.weights()
    theirs = fit(config, url, tmp_path / "theirs").material.model.weights()
    assert all((mine[name] == theirs[name]).all() for name in mine)


def test_shards_are_downloaded_once(url: str, local: Path, downloads: list[str]) -> None:
    data = Dataset.open(url)
    training = load_training(data, HELD_OUT, 0, memory=1.0).training
    assert sorted(downloads) == [path.name for path in sorted(local.glob("train-*.npz"))]
    list(islice(training.batches(700, 0, 0), 30))  # type: ignore[arg-type, call-overload]
    assert len(downloads) == 8


def test_the_cache_is_bounded(tmp_path: Path, url: str, local: Path, downloads: list[str]) -> None:
    size = max(path.stat().st_size for path in local.glob("train-*.npz"))
    data = Dataset.open(url, cache=5 * size)
    training = load_training(data, HELD_OUT, 0, memory=1.0).training
    for _ in islice(training.batches(700, 0, 0), 30):  # type: ignore[arg-type, call-overload]
        assert cached(tmp_path) <= 6 * size
    assert len(downloads) > 8


def test_a_shard_that_leaves_the_cache_before_it_is_opened(
    url: str, local: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, left = DataFolder.file, [3]

    def evicted(self: DataFolder, name: str, sha256: str, size: int | None = None) -> Path:
        path = original(self, name, sha256, size)
        if left[0]:
            left[0] -= 1
            path.unlink()
        return path

    monkeypatch.setattr(DataFolder, "file", evicted)
    found = Dataset.open(url).shards("train")[0].read()
    assert left == [0]
    expected = Dataset.open(local).shards("train")[0].read()
    assert all((found[name] == expected[name]).all() for name in expected)


def test_a_lost_store_leaves_a_checkpoint(
    tmp_path: Path, url: str, local: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fit resumes where it was, with the result of an undisturbed one."""
    options = {"training": {"steps": 30, "batch": 700}, "data": {"memory": "1kB", "cache": "1kB"}}
    config = FitConfig.model_validate(options)
    whole = fit(config, local, tmp_path / "whole").material.model.weights()
    original, left = StreamedQueries.slice, [12]

    def cut(self: StreamedQueries, start: int, stop: int) -> object:
        left[0] -= 1
        if left[0] < 0:
            raise PartialError("the store cannot be reached")
        return original(self, start, stop)

    with monkeypatch.context() as patch:
        patch.setattr(StreamedQueries, "slice", cut)
        with pytest.raises(PartialError):
            fit(config, url, tmp_path / "m")
    assert (tmp_path / "m" / CHECKPOINT_NAME).exists()
    result = fit(config, url, tmp_path / "m")
    found = result.material.model.weights()
    assert result.resumed
    assert all((whole[name] == found[name]).all() for name in whole)

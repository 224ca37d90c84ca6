"""Data sets in an object store behave as local ones: made, resumed, checked, repaired, replaced."""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.datasets import flip
from support.object_stores import downloaded, memory_store
from support.small_runs import command, contents, generate, noisy_plane

from mbtf_core.app.console import run
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.documents import upload_waiting
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.schema import ShardEntry
from mbtf_core.data.store import ObjectStore, StoredFile
from mbtf_core.data.verify import verify
from mbtf_core.errors import InputError, MbtfError, PartialError
from mbtf_core.files.atomic import checksummed
from mbtf_core.run.task import exhausted
from mbtf_gen.cli.app import app
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.folder import read_run_plan
from mbtf_gen.generation.run import ShardRun, render_shard
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.simulation import ClosedForm


@pytest.fixture(autouse=True)
def fast_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ClosedForm, "estimate", noisy_plane)
    monkeypatch.setattr(os, "fsync", lambda handle: None)


@pytest.fixture
def url(tmp_path: Path) -> Iterator[str]:
    with memory_store(tmp_path / "cache") as found:
        yield found


def command_at(folder: Path, url: str, *more: str, **options: Any) -> list[str]:
    line = command(folder, Path("OUT"), **options)
    return [url if word == "OUT" else word for word in line] + list(more)


@pytest.mark.parametrize("suffix", ["npz", "exr"])
def test_the_bits_are_those_of_a_local_run(tmp_path: Path, url: str, suffix: str) -> None:
    form = ["--format", suffix]
    assert generate(command(tmp_path, tmp_path / "local") + form) == 0
    assert generate(command_at(tmp_path, url, *form)) == 0
    assert contents(downloaded(url, tmp_path / "copy")) == contents(tmp_path / "local")
    assert verify(url) == []
    local, stored = Dataset.open(tmp_path / "local"), Dataset.open(url)
    for split in local.splits:
        mine, theirs = local.load(split), stored.load(split)
        assert all((mine[name] == theirs[name]).all() for name in mine)
    assert stored.geometry() is not None


def waiting(folder: Path) -> list[str]:
    """Files that are not uploaded."""
    return [path.name for path in (folder / "cache/mbtf/stores/waiting").glob("*/*")]


def test_a_list_that_lags_behind(tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The data set is not complete before the store shows all of it."""
    original = ObjectStore.list

    def late(self: ObjectStore) -> dict[str, StoredFile]:
        return {name: found for name, found in original(self).items() if name != "train-00001.npz"}

    with monkeypatch.context() as patch:
        patch.setattr(ObjectStore, "list", late)
        assert generate(command_at(tmp_path, url)) == 4
    assert not json.loads(ObjectStore(url).read("manifest.json"))["complete"]
    assert generate(command_at(tmp_path, url)) == 0
    assert generate(command(tmp_path, tmp_path / "local")) == 0
    assert contents(downloaded(url, tmp_path / "copy")) == contents(tmp_path / "local")


def test_the_manifest_of_another_writer_is_adopted(
    tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another machine stores its manifest between this one's look at the store and its own."""
    assert generate(command_at(tmp_path, url)) == 0
    theirs = checksummed({**json.loads(ObjectStore(url).read("manifest.json")), "note": "theirs"})
    for name in ObjectStore(url).list():
        ObjectStore(url).delete(name)
    original = ObjectStore.write

    def late(self: ObjectStore, name: str, content: bytes, *, new: bool = False) -> bool:
        if name == "manifest.json" and not self.list():
            original(self, name, theirs)
        return original(self, name, content, new=new)

    with monkeypatch.context() as patch:
        patch.setattr(ObjectStore, "write", late)
        assert generate(command_at(tmp_path, url)) == 0
    assert verify(url) == []
    assert json.loads(ObjectStore(url).read("manifest.json"))["note"] == "theirs"


def test_a_shard_without_sidecar_is_replaced(tmp_path: Path, url: str) -> None:
    """A writer was killed between the two; another machine may compute other bits."""
    assert generate(command_at(tmp_path, url)) == 0
    expected = contents(downloaded(url, tmp_path / "before"))
    store = ObjectStore(url)
    store.delete("train-00001.json")
    store.write("train-00001.npz", b"other bits")
    assert generate(command_at(tmp_path, url)) == 0
    assert contents(downloaded(url, tmp_path / "after")) == expected


def test_the_shard_of_another_writer_is_kept(
    tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two writers without slices: the one that comes second adopts what the first has finished."""
    assert generate(command_at(tmp_path, url)) == 0
    store = ObjectStore(url)
    shard, sidecar = store.read("train-00001.npz"), store.read("train-00001.json")
    store.delete("train-00001.json")
    store.delete("train-00001.npz")
    original = ObjectStore.write

    def late(self: ObjectStore, name: str, content: bytes, *, new: bool = False) -> bool:
        if name == "train-00001.npz":
            original(self, name, shard)
            original(self, "train-00001.json", sidecar)
            content = content[:-1]  # the bits of another type of machine
        return original(self, name, content, new=new)

    with monkeypatch.context() as patch:
        patch.setattr(ObjectStore, "write", late)
        assert generate(command_at(tmp_path, url)) == 0
    assert store.read("train-00001.json") == sidecar
    assert verify(url) == []


def test_corruption_is_found_and_repaired(
    tmp_path: Path, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert generate(command_at(tmp_path, url)) == 0
    expected = contents(downloaded(url, tmp_path / "before"))
    Dataset.open(url).load("train")  # the cache has the intact shards
    store = ObjectStore(url)
    flipped = bytearray(store.read("train-00001.npz"))
    flipped[-100] ^= 1
    store.write("train-00001.npz", bytes(flipped))
    store.delete("train-00000.npz")
    store.write("geometry.exr", store.read("geometry.exr")[:-1])
    store.delete("config.yaml")
    store.write("notes.txt", b"mine")
    faulty = {"train-00000.npz", "train-00001.npz", "geometry.exr", "config.yaml"}
    assert {fault.file for fault in verify(url)} == faulty
    assert run(app, ["verify", url, "-q"]) == 3
    assert f"mbtf-gen repair {url}" in capsys.readouterr().out
    for lost in ("nothing else", "manifest.json"):
        store.delete(lost)
        assert run(app, ["repair", url, "-q"]) == 0
    assert verify(url) == []
    found = contents(downloaded(url, tmp_path / "after"))
    assert found.pop("notes.txt") == b"mine"
    assert found == expected


def test_another_configuration_is_refused_and_replaced(
    tmp_path: Path, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert generate(command_at(tmp_path, url)) == 0
    assert generate(command_at(tmp_path, url, train=50)) == 3
    assert f"{url}: holds a data set of another configuration" in capsys.readouterr().err
    assert generate(command_at(tmp_path, url, "--overwrite", train=50)) == 0
    assert generate(command(tmp_path, tmp_path / "local", train=50)) == 0
    assert contents(downloaded(url, tmp_path / "copy")) == contents(tmp_path / "local")


def test_a_digest_names_no_file_elsewhere(tmp_path: Path, url: str) -> None:
    assert generate(command_at(tmp_path, url)) == 0
    store = ObjectStore(url)
    record = json.loads(store.read("train-00001.json"))
    store.write("train-00001.json", checksummed(record | {"sha256": f"../{'0' * 61}"}))
    with pytest.raises(InputError, match="sha256"):
        Dataset.open(url).load("train")


@pytest.mark.parametrize("error", [PartialError, InputError])
def test_shards_that_could_not_be_uploaded_wait(
    tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch, error: type[MbtfError]
) -> None:
    """The connection ends during a run, or the credentials do: the next run uploads what is rendered."""
    assert generate(command(tmp_path, tmp_path / "local", train=200)) == 0
    rendered: list[str] = []
    original, estimate = ObjectStore.write, ClosedForm.estimate

    def cut(self: ObjectStore, name: str, content: bytes, *, new: bool = False) -> bool:
        if name.startswith("train-00001"):
            raise error("the store cannot be reached", where=self.url)
        return original(self, name, content, new=new)

    def counted(self: ClosedForm, *arguments: Any, **options: Any) -> Any:
        rendered.append("")
        return estimate(self, *arguments, **options)

    monkeypatch.setattr(ClosedForm, "estimate", counted)
    with monkeypatch.context() as patch:
        patch.setattr(ObjectStore, "write", cut)
        # The second one has to leave what the first one left.
        for _ in range(2):
            assert generate(command_at(tmp_path, url, train=200)) == error.exit_code
            assert "train-00001.npz" in {fault.file for fault in verify(url)}
    assert generate(command_at(tmp_path, url, train=200)) == 0
    # Every shard was rendered once.
    assert len(rendered) == 6
    assert contents(downloaded(url, tmp_path / "copy")) == contents(tmp_path / "local")
    assert waiting(tmp_path) == []


@pytest.fixture
def left(tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A shard that a process which has ended could not upload."""
    with monkeypatch.context() as patch:
        patch.setattr(ObjectStore, "write", _documents_only)
        assert generate(command_at(tmp_path, url)) == 4
    return min(DataFolder.open(url).workspace.glob("*.npz"))


def test_damaged_leftovers_are_rendered_again(tmp_path: Path, url: str, left: Path) -> None:
    flip(left, -100)
    assert generate(command_at(tmp_path, url)) == 0
    assert generate(command(tmp_path, tmp_path / "local")) == 0
    assert contents(downloaded(url, tmp_path / "copy")) == contents(tmp_path / "local")


@pytest.mark.parametrize("other", ["url", "config_hash", "plan", ""])
def test_leftovers_of_another_data_set_are_not_uploaded(url: str, left: Path, other: str) -> None:
    record = json.loads(left.with_suffix(".json").read_bytes())
    entry = ShardEntry(record["split"], record["index"], record["file"], record["rows"])
    record = {"url": url} | record | {other: f"{url}-other" if other == "url" else "0" * 64}
    sent = upload_waiting(DataFolder.open(record["url"]), [entry], record["config_hash"], record["plan"])
    assert sent == ([] if other else [left.name])
    assert (left.name in ObjectStore(record["url"]).list()) == (not other)
    # It is left to the next writer of its URL.
    assert left.exists() == (other == "url")


def test_a_leftover_replaces_the_sidecar_of_a_lost_shard(
    tmp_path: Path, url: str, left: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, sidecar = ObjectStore(url), f"{left.stem}.json"
    store.write(sidecar, b"of a shard that is gone")
    with monkeypatch.context() as patch:
        patch.setattr(ObjectStore, "write", _documents_only)
        assert generate(command_at(tmp_path, url)) == 4
    # A sidecar is never there before its shard, nor does a leftover go before it is uploaded.
    assert sidecar not in store.list()
    assert left.exists()
    assert generate(command_at(tmp_path, url)) == 0
    assert verify(url) == []


def test_a_worker_looks_again_for_a_shard_that_it_knows(tmp_path: Path, url: str) -> None:
    """It runs longer than a command, and others may remove what it has stored."""
    assert generate(command_at(tmp_path, url)) == 0
    material = str(tmp_path / "plane.npy")
    config = json.loads(ObjectStore(url).read("manifest.json"))["config"] | {"material": material}
    job, folder = Job.load(GeneratorConfig.model_validate(config)), DataFolder.open(url)
    sent = pickle.dumps(ShardRun(job, folder, read_run_plan(folder)))

    def rendered() -> bool:
        (entry,) = (entry for entry in job.shards if entry.file == "train-00001.npz")
        return bool(exhausted(render_shard(pickle.loads(sent), entry))["rendered"])

    assert not rendered()
    ObjectStore(url).delete("train-00001.npz")
    assert rendered()
    assert verify(url) == []


_write = ObjectStore.write


def _documents_only(self: ObjectStore, name: str, content: bytes, *, new: bool = False) -> bool:
    """The store is reached for documents alone."""
    if name.startswith(("train", "test")):
        raise PartialError("the store cannot be reached")
    return _write(self, name, content, new=new)

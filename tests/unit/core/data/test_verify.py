"""``verify`` finds what is wrong with a folder of shards, and nothing where nothing is."""

from __future__ import annotations

import json
import shutil
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.datasets import edit, write_dataset

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.documents import finished_record
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.schema import ShardEntry
from mbtf_core.data.shard_files import read_shard, write_shard
from mbtf_core.data.verify import foreign_files, verify
from mbtf_core.files.atomic import file_sha256

FORMATS = ["npz", "exr"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One intact data set per format: three training shards, one test shard."""
    folder = tmp_path_factory.mktemp("sets")
    for suffix in FORMATS:
        write_dataset(
            folder / suffix,
            queries={"train": "100", "test": "40"},
            output={"shard_queries": 40, "format": suffix},
        )
    return {suffix: folder / suffix for suffix in FORMATS}


@pytest.fixture(params=FORMATS)
def copy(request: pytest.FixtureRequest, made: dict[str, Path], tmp_path: Path) -> Path:
    """A copy of a data set, to damage; its name is its format."""
    shutil.copytree(made[request.param], tmp_path / request.param)
    return tmp_path / request.param


def shard(folder: Path, number: int = 1) -> Path:
    return folder / f"train-{number:05d}.{folder.name}"


def entry(folder: Path, rows: int, number: int = 1) -> ShardEntry:
    return ShardEntry("train", number, shard(folder, number).name, rows)


def faults(folder: Path) -> dict[str, str]:
    return {f.file: f.what for f in verify(folder)}


def foreign(folder: Path) -> list[str]:
    dataset = Dataset.open(folder)
    return foreign_files(
        DataFolder.open(folder), [e for split in dataset.splits for e in dataset.entries(split)]
    )


def sidecar_of(shard: Path) -> Path:
    return shard.with_suffix(".json")


def test_every_flipped_byte_is_found(copy: Path) -> None:
    for path in (copy / "geometry.exr", shard(copy)):
        intact = path.read_bytes()
        # Ends, headers, numbers: a spread over the file.
        for position in [*range(0, len(intact), len(intact) // 40), len(intact) - 1]:
            damaged = bytearray(intact)
            damaged[position] ^= 0x10
            path.write_bytes(damaged)
            assert list(faults(copy)) == [path.name], position
        if path.stem == "geometry":
            path.write_bytes(intact)
    wanted = json.loads((copy / "manifest.json").read_text())["config_hash"]
    # On resuming, sidecar and size alone are checked.
    assert finished_record(DataFolder.open(copy), entry(copy, 40), wanted)
    assert finished_record(DataFolder.open(copy), entry(copy, 39), wanted) is None
    path.write_bytes(intact)
    assert verify(copy) == []


@pytest.mark.parametrize("kept", [0, 1, 100, -1])
def test_a_truncated_shard_is_found(copy: Path, kept: int) -> None:
    path = shard(copy)
    path.write_bytes(path.read_bytes()[:kept])
    assert "bytes" in faults(copy)[path.name]
    # Size alone decides whether it counts as finished on resuming.
    manifest = json.loads((copy / "manifest.json").read_text())
    assert not finished_record(DataFolder.open(copy), entry(copy, 40), manifest["config_hash"])
    assert finished_record(DataFolder.open(copy), entry(copy, 40, 0), manifest["config_hash"])


def test_missing_parts_are_found(copy: Path) -> None:
    (copy / "geometry.exr").unlink()
    shard(copy, 0).unlink()
    sidecar_of(shard(copy, 1)).unlink()
    assert faults(copy) == {
        "geometry.exr": "is missing",
        shard(copy, 0).name: "is missing",
        shard(copy, 1).name: "is unfinished (no sidecar)",
    }


def test_a_doubled_shard_is_found(copy: Path) -> None:
    # Under a new name, with or without its sidecar.
    extra = shard(copy, 7)
    shutil.copy(shard(copy, 1), extra)
    assert (faults(copy), foreign(copy)) == ({}, [extra.name])
    shutil.copy(sidecar_of(shard(copy, 1)), sidecar_of(extra))
    assert (faults(copy), foreign(copy)) == ({}, sorted([sidecar_of(extra).name, extra.name]))
    extra.unlink()
    sidecar_of(extra).unlink()
    # In place of its neighbor.
    shutil.copy(shard(copy, 1), shard(copy, 0))
    assert "SHA-256" in faults(copy)[shard(copy, 0).name]
    shutil.copy(sidecar_of(shard(copy, 1)), sidecar_of(shard(copy, 0)))
    assert faults(copy)[shard(copy, 0).name] == f"has the sidecar of {shard(copy, 1).name}"
    edit(sidecar_of(shard(copy, 0)), lambda record: record.update(file=shard(copy, 0).name))
    assert "has the index 1, manifest.json says 0" in faults(copy)[shard(copy, 0).name]
    edit(sidecar_of(shard(copy, 0)), lambda record: record.update(index=0))
    # Which of the two is the copy, nobody knows.
    assert faults(copy) == {
        shard(copy, i).name: f"has the same content as {shard(copy, 1 - i).name}" for i in (0, 1)
    }


def test_wrong_records_are_found(copy: Path) -> None:
    manifest, sidecar = copy / "manifest.json", sidecar_of(shard(copy))
    intact = manifest.read_text()

    def double(record: dict[str, Any]) -> None:
        shards = record["splits"]["train"]["shards"]
        shards.append(shards[0])

    edit(manifest, double)
    assert faults(copy) == {shard(copy, 0).name: "is listed twice"}
    manifest.write_text(intact)
    edit(manifest, lambda record: record.update(complete=False))
    assert "not complete" in faults(copy)["manifest.json"]
    manifest.write_text(intact)
    edit(sidecar, lambda record: record.update(plan="0" * 64))
    assert list(faults(copy).values()) == ["was rendered with another plan"]


def test_foreign_files_are_found(copy: Path, made: dict[str, Path], tmp_path: Path) -> None:
    (copy / "render.exr").write_bytes(b"of somebody else")
    (copy / "notes.txt").write_text("harmless")
    (copy / "preview").mkdir()
    # Of a killed run, and the lock of a running one.
    (copy / ".train-00001.npz.0123abcd-77.tmp").touch()
    (copy / ".train-00002.lock").touch()
    assert (faults(copy), foreign(copy)) == ({}, ["notes.txt", "preview/", "render.exr"])
    output = {"shard_queries": 40, "format": copy.name}
    other = write_dataset(tmp_path / "other", queries={"train": "100", "test": "40"}, output=output, seed=1)
    for path in (shard(copy), sidecar_of(shard(copy))):
        path.write_bytes(other.folder.read(path.name))
    assert faults(copy) == {shard(copy).name: "belongs to another data set than manifest.json"}


def test_wrong_rows_and_bad_numbers_are_found_behind_a_true_digest(copy: Path) -> None:
    path = shard(copy)
    intact = {name: np.array(array) for name, array in read_shard(path).items()}

    def replace(arrays: dict[str, Any]) -> str:
        write_shard(path, arrays)
        edit(sidecar_of(path), lambda r: r.update(bytes=path.stat().st_size, sha256=file_sha256(path)))
        return faults(copy).get(path.name, "nothing")

    assert replace(intact) == "nothing"
    assert "39 rows" in replace({name: array[:39] for name, array in intact.items()})
    for bad in (np.nan, np.inf):
        spoilt = intact["value_b"].copy()
        spoilt[7, 1] = bad
        found = replace({**intact, "value_b": spoilt})
        assert found == "'value_b' holds NaN or infinite numbers: 1, the first in row 7"
    assert "unit vectors" in replace({**intact, "omega_o": 2 * intact["omega_o"]})


def test_headers_are_parsed_in_one_thread(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In several threads an intact header may seem corrupt (CPython issue 106905)."""
    alone = threading.Lock()

    def read(path: Path) -> Any:
        assert alone.acquire(blocking=False)
        time.sleep(0.01)
        alone.release()
        return read_shard(path)

    monkeypatch.setattr("mbtf_core.data.verify.read_shard", read)
    assert verify(copy) == []


@pytest.mark.parametrize("text", ["", "{}"])
def test_a_broken_sidecar_is_a_fault_not_an_abort(copy: Path, text: str) -> None:
    sidecar_of(shard(copy)).write_text(text)
    assert list(faults(copy)) == [shard(copy).name]
    assert not finished_record(DataFolder.open(copy), entry(copy, 40), "any")

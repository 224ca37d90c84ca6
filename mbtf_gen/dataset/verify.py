"""Checks a folder of shards against its manifest and digests."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.atomic import read_checksummed
from mbtf_core.digest import file_sha256
from mbtf_core.errors import InputError, reason
from mbtf_core.shard_schema import CONFIG_NAME, FORMAT_NAME, MANIFEST_NAME, SPLITS
from mbtf_gen.dataset.manifest import ShardEntry, effects_digest
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.shard_io import check_arrays, read_shard

# What is said of a shard that is not there yet; an interrupted run leaves many of them.
_ABSENT = ("is missing", "is unfinished (no sidecar)")
_INCOMPLETE = "is not complete"
_TWICE = "is listed twice"
_UNLISTED = "is not listed in the manifest"
_MAKE = "run the same mbtf-gen command again: it makes what is missing"
_REMAKE = "mend it with: mbtf-gen repair FOLDER"

# The reader of EXR files silences its library, which concerns the whole process.
_ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong: the file, what it is, and what to do about it."""

    file: str
    what: str
    hint: str

    @property
    def absent(self) -> bool:
        """Whether the file is only not there yet."""
        return self.what in _ABSENT

    @property
    def unfinished(self) -> bool:
        """Whether the manifest only lacks its completion."""
        return self.what == _INCOMPLETE

    @property
    def listing(self) -> bool:
        """Whether the manifest is at fault, not the shard that it names."""
        return self.what == _TWICE

    @property
    def unlisted(self) -> bool:
        """Whether the file is of somebody else's making, or a copy."""
        return self.what == _UNLISTED


def sidecar_of(shard: Path) -> Path:
    """The JSON file beside a shard; it is written last and makes the shard count as finished."""
    return shard.with_suffix(".json")


def shard_fault(path: Path, rows: int, config_hash: str, *, digests: bool = True) -> str | None:
    """What is wrong with one shard, or None.

    Parameters
    ----------
    rows : queries (or images) it must hold
    digests : also read the whole file and compare its SHA-256; else only its sidecar and its size
    """
    return examine(path, rows, config_hash, digests=digests)[1]


def examine(
    path: Path, rows: int, config_hash: str, *, digests: bool = True
) -> tuple[dict[str, Any] | None, str | None]:
    """(sidecar, fault) of one shard: one of the two is None, see :func:`shard_fault`."""
    try:
        record = _record_of(path, rows, config_hash)
        if isinstance(record, str):
            return None, record
        fault = _content_fault(path, rows, record) if digests else None
        return (record, None) if fault is None else (None, fault)
    except InputError as error:
        return None, error.what
    except (KeyError, OSError) as error:
        return None, f"cannot be checked ({reason(error)})"


def _record_of(path: Path, rows: int, config_hash: str) -> dict[str, Any] | str:
    """Sidecar of a shard, or what is wrong with it or with the shard's size."""
    sidecar = sidecar_of(path)
    if not path.exists():
        return _ABSENT[0]
    if not sidecar.exists():
        return _ABSENT[1]
    try:
        record = read_checksummed(sidecar)
    except InputError as error:
        return f"has a damaged sidecar: {error.what}"
    if record.get("format") != FORMAT_NAME or record.get("config_hash") != config_hash:
        return "belongs to another data set"
    if record.get("file") != path.name:
        return f"has the sidecar of {record.get('file')}"
    if record["rows"] != rows:
        return f"holds {record['rows']} rows, the manifest says {rows}"
    if path.stat().st_size != record["bytes"]:
        return f"has {path.stat().st_size} bytes, its sidecar says {record['bytes']}"
    return record


def _content_fault(path: Path, rows: int, record: dict[str, Any]) -> str | None:
    """What is wrong with the bytes and the numbers of a shard."""
    if file_sha256(path) != record["sha256"]:
        return "has changed since it was written (SHA-256 differs)"
    with _ONE_AT_A_TIME if path.suffix == ".exr" else contextlib.nullcontext():
        arrays = read_shard(path)
    if check_arrays(arrays, path)[0] != rows:
        return f"holds {check_arrays(arrays, path)[0]} rows, the manifest says {rows}"
    for name, array in arrays.items():
        # Both pass on NaN, and an infinity is one of them.
        if not (np.isfinite(np.min(array)) and np.isfinite(np.max(array))):
            return f"holds NaN or infinite numbers in '{name}'"
    return None


def _manifest_faults(dataset: Dataset) -> Iterator[Fault]:
    folder = dataset.folder
    try:
        read_checksummed(folder / MANIFEST_NAME)
    except InputError as error:
        yield Fault(MANIFEST_NAME, error.what, _REMAKE)
    config = folder / CONFIG_NAME
    if not config.exists():
        yield Fault(CONFIG_NAME, "is not there", _REMAKE)
    elif file_sha256(config) != dataset.manifest.get("config_yaml"):
        yield Fault(CONFIG_NAME, "has changed since it was written (SHA-256 differs)", _REMAKE)


def shard_faults(
    folder: Path, entries: Sequence[ShardEntry], config_hash: str, effects: str
) -> Iterator[Fault]:
    """Faults of the listed shards, which several threads read at once.

    Parameters
    ----------
    effects : digest of the effects plan that all shards were made with
    """
    listed: set[str] = set()
    first: dict[str, str] = {}
    with ThreadPoolExecutor(max(2, os.cpu_count() or 1), "verify") as pool:
        examined = pool.map(lambda e: examine(folder / e.file, e.rows, config_hash), entries)
        for entry, (record, fault) in zip(entries, examined, strict=True):
            if entry.file in listed:
                yield Fault(entry.file, _TWICE, _REMAKE)
            listed.add(entry.file)
            if record is not None and record.get("effects") != effects:
                fault = "was made under another effects plan"
            elif record is not None:
                twin = first.setdefault(record["sha256"], entry.file)
                if twin != entry.file:
                    fault = f"has the same content as {twin}"
                    # Which of the two is the copy, nobody knows.
                    yield Fault(twin, f"has the same content as {entry.file}", _REMAKE)
            if fault is not None:
                yield Fault(entry.file, fault, _MAKE if fault in _ABSENT else _REMAKE)


def verify(folder: Path) -> list[Fault]:
    """All faults of a data set: flipped bytes, truncated, missing or foreign shards, an unfinished manifest.

    Raises
    ------
    InputError : the folder holds no data set of this schema
    """
    folder = Path(folder)
    dataset = Dataset.open(folder)
    faults = list(_manifest_faults(dataset))
    entries = [
        ShardEntry(split, index, entry["file"], entry["rows"])
        for split in SPLITS
        for index, entry in enumerate(dataset.manifest["splits"].get(split, {"shards": []})["shards"])
    ]
    effects = effects_digest(dataset.manifest.get("effects") or {})
    faults += shard_faults(folder, entries, dataset.manifest["config_hash"], effects)
    listed = {entry.file for entry in entries}
    for path in sorted(folder.iterdir()):
        if path.suffix in (".npz", ".exr") and path.name not in listed:
            faults.append(Fault(path.name, _UNLISTED, "remove it"))
    if not faults and not dataset.manifest.get("complete"):
        hint = "run the same mbtf-gen command again, or mbtf-gen merge"
        faults.append(Fault(MANIFEST_NAME, _INCOMPLETE, hint))
    return faults


def finished_record(path: Path, rows: int, config_hash: str) -> dict[str, Any] | None:
    """Sidecar of a shard that is complete by its sidecar and size (its bytes are not read), or None."""
    return examine(path, rows, config_hash, digests=False)[0]


def is_finished(path: Path, rows: int, config_hash: str) -> bool:
    """Whether a shard is complete by its sidecar and size (its bytes are not read)."""
    return finished_record(path, rows, config_hash) is not None

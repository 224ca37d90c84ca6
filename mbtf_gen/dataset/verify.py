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
from mbtf_core.shard_schema import CONFIG_NAME, FORMAT_NAME, MANIFEST_NAME, SPLITS, ShardEntry
from mbtf_gen.dataset.manifest import plan_digest
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.shard_io import check_arrays, read_shard

# Faults of shards that are not rendered yet; an interrupted run leaves many of them.
_ABSENT = ("is missing", "is unfinished (no sidecar)")
_INCOMPLETE = "is not complete"
_TWICE = "is listed twice"
_UNLISTED = "is not listed in the manifest"
_RESUME = "run the same mbtf-gen command again: it renders the missing shards"
_REPAIR = "repair it with: mbtf-gen repair FOLDER"

# The reader of EXR files redirects the standard error stream of the whole process.
_ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class Fault:
    """One fault of a data set.

    Attributes
    ----------
    file : str
        Name of the file.
    what : str
        The fault, in words.
    hint : str
        What to do about it.
    """

    file: str
    what: str
    hint: str

    @property
    def absent(self) -> bool:
        """Whether the file is not written yet."""
        return self.what in _ABSENT

    @property
    def unfinished(self) -> bool:
        """Whether the manifest only lacks its completion."""
        return self.what == _INCOMPLETE

    @property
    def listing(self) -> bool:
        """Whether the fault lies in the manifest, not in the shard that it names."""
        return self.what == _TWICE

    @property
    def unlisted(self) -> bool:
        """Whether the file is foreign, or a copy."""
        return self.what == _UNLISTED


def sidecar_of(shard: Path) -> Path:
    """The JSON file beside a shard. It is written last and marks the shard as finished."""
    return shard.with_suffix(".json")


def shard_fault(path: Path, rows: int, config_hash: str, *, digests: bool = True) -> str | None:
    """The fault of one shard, or None.

    Parameters
    ----------
    rows : queries (or images) that it must contain
    digests : read the whole file and compare its SHA-256; otherwise check only its sidecar and its size
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
    """Sidecar of a shard, or the fault of the sidecar or of the shard's size."""
    sidecar = sidecar_of(path)
    if not path.exists():
        return _ABSENT[0]
    if not sidecar.exists():
        return _ABSENT[1]
    try:
        record = read_checksummed(sidecar)
    except InputError as error:
        return f"has a corrupt sidecar: {error.what}"
    if record.get("format") != FORMAT_NAME or record.get("config_hash") != config_hash:
        return "belongs to another data set"
    if record.get("file") != path.name:
        return f"has the sidecar of {record.get('file')}"
    if record["rows"] != rows:
        return f"has {record['rows']} rows, the manifest says {rows}"
    if path.stat().st_size != record["bytes"]:
        return f"has {path.stat().st_size} bytes, its sidecar says {record['bytes']}"
    return record


def _content_fault(path: Path, rows: int, record: dict[str, Any]) -> str | None:
    """The fault of a shard's bytes or values, or None."""
    if file_sha256(path) != record["sha256"]:
        return "has changed since it was written (SHA-256 differs)"
    with _ONE_AT_A_TIME if path.suffix == ".exr" else contextlib.nullcontext():
        arrays = read_shard(path)
    if check_arrays(arrays, path)[0] != rows:
        return f"has {check_arrays(arrays, path)[0]} rows, the manifest says {rows}"
    for name, array in arrays.items():
        # Minimum and maximum are NaN if any value is.
        if not (np.isfinite(np.min(array)) and np.isfinite(np.max(array))):
            return f"has NaN or infinite values in '{name}'"
    return None


def _manifest_faults(dataset: Dataset) -> Iterator[Fault]:
    folder = dataset.folder
    try:
        read_checksummed(folder / MANIFEST_NAME)
    except InputError as error:
        yield Fault(MANIFEST_NAME, error.what, _REPAIR)
    config = folder / CONFIG_NAME
    if not config.exists():
        yield Fault(CONFIG_NAME, "is missing", _REPAIR)
    elif file_sha256(config) != dataset.manifest.get("config_yaml"):
        yield Fault(CONFIG_NAME, "has changed since it was written (SHA-256 differs)", _REPAIR)


def shard_faults(folder: Path, entries: Sequence[ShardEntry], config_hash: str, plan: str) -> Iterator[Fault]:
    """Faults of the listed shards, read by several threads.

    Parameters
    ----------
    plan : digest of the run plan that all shards must have
    """
    listed: set[str] = set()
    first: dict[str, str] = {}
    with ThreadPoolExecutor(max(2, os.cpu_count() or 1), "verify") as pool:
        examined = pool.map(lambda e: examine(folder / e.file, e.rows, config_hash), entries)
        for entry, (record, fault) in zip(entries, examined, strict=True):
            if entry.file in listed:
                yield Fault(entry.file, _TWICE, _REPAIR)
            listed.add(entry.file)
            if record is not None and record.get("plan") != plan:
                fault = "was rendered with another plan"
            elif record is not None:
                twin = first.setdefault(record["sha256"], entry.file)
                if twin != entry.file:
                    fault = f"has the same content as {twin}"
                    # Either of the two may be the copy.
                    yield Fault(twin, f"has the same content as {entry.file}", _REPAIR)
            if fault is not None:
                yield Fault(entry.file, fault, _RESUME if fault in _ABSENT else _REPAIR)


def verify(folder: Path) -> list[Fault]:
    """Find all faults of a data set: changed, truncated, missing or foreign files, an unfinished manifest.

    Parameters
    ----------
    folder : Path
        The data set.

    Returns
    -------
    list of Fault
        Empty for an intact, complete data set.

    Raises
    ------
    InputError
        The folder contains no data set of this schema version.
    """
    folder = Path(folder)
    dataset = Dataset.open(folder)
    faults = list(_manifest_faults(dataset))
    entries = [
        ShardEntry(split, index, entry["file"], entry["rows"])
        for split in SPLITS
        for index, entry in enumerate(dataset.manifest["splits"].get(split, {"shards": []})["shards"])
    ]
    faults += shard_faults(folder, entries, dataset.manifest["config_hash"], plan_digest(dataset.manifest))
    listed = {entry.file for entry in entries}
    for path in sorted(folder.iterdir()):
        if path.suffix in (".npz", ".exr") and path.name not in listed:
            faults.append(Fault(path.name, _UNLISTED, "remove it"))
    if not faults and not dataset.manifest.get("complete"):
        hint = "run the same mbtf-gen command again, or mbtf-gen merge"
        faults.append(Fault(MANIFEST_NAME, _INCOMPLETE, hint))
    return faults


def finished_record(path: Path, rows: int, config_hash: str) -> dict[str, Any] | None:
    """Sidecar of a shard that is finished by its sidecar and size (its bytes are not read), or None."""
    return examine(path, rows, config_hash, digests=False)[0]


def is_finished(path: Path, rows: int, config_hash: str) -> bool:
    """Whether a shard is finished by its sidecar and size (its bytes are not read)."""
    return finished_record(path, rows, config_hash) is not None

"""Checks a folder of shards against its manifest and digests."""

from __future__ import annotations

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
ABSENT = ("is missing", "is unfinished (no sidecar)")
# The manifest only lacks its completion.
INCOMPLETE = "is not complete"
# A fault of the manifest, not of the shard that it names.
TWICE = "is listed twice"
# A foreign file, or a copy.
UNLISTED = "is not listed in the manifest"
_CHANGED = "has changed since it was written (SHA-256 differs)"
_RESUME = "run the same mbtf-gen command again: it renders the missing shards"
_REPAIR = "repair it with: mbtf-gen repair FOLDER"

# The reader of EXR files redirects the standard error stream of the whole process. NumPy parses headers with
# `ast`, which may fail in several threads before Python 3.11.8 and 3.12.2 (CPython issue 106905).
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


def sidecar_of(shard: Path) -> Path:
    """The JSON file beside a shard. It is written last and marks the shard as finished."""
    return shard.with_suffix(".json")


def examine(path: Path, rows: int, config_hash: str) -> tuple[dict[str, Any] | None, str | None]:
    """(sidecar, None) or (None, fault) of a shard, whose whole file is read.

    Parameters
    ----------
    rows : queries (or images) that it must contain
    """
    try:
        record = _sidecar(path, rows, config_hash)
        _check_content(path, rows, record)
        return record, None
    except InputError as error:
        return None, error.what
    except (KeyError, OSError) as error:
        return None, f"cannot be checked ({reason(error)})"


def finished_record(path: Path, rows: int, config_hash: str) -> dict[str, Any] | None:
    """Sidecar of a shard that is finished by its sidecar and size (its bytes are not read), or None."""
    try:
        return _sidecar(path, rows, config_hash)
    except (InputError, KeyError, OSError):
        return None


def _sidecar(path: Path, rows: int, config_hash: str) -> dict[str, Any]:
    """Sidecar of a shard; an InputError where it is at fault, or the shard's size."""
    sidecar = sidecar_of(path)
    for file, fault in zip((path, sidecar), ABSENT, strict=True):
        if not file.exists():
            raise InputError(fault)
    try:
        record = read_checksummed(sidecar)
    except InputError as error:
        raise InputError(f"has a corrupt sidecar: {error.what}") from None
    if record.get("format") != FORMAT_NAME or record.get("config_hash") != config_hash:
        raise InputError("belongs to another data set")
    if record.get("file") != path.name:
        raise InputError(f"has the sidecar of {record.get('file')}")
    if record["rows"] != rows:
        raise InputError(f"has {record['rows']} rows, the manifest says {rows}")
    if path.stat().st_size != record["bytes"]:
        raise InputError(f"has {path.stat().st_size} bytes, its sidecar says {record['bytes']}")
    return record


def _check_content(path: Path, rows: int, record: dict[str, Any]) -> None:
    """An InputError where the bytes or values of a shard are at fault."""
    if file_sha256(path) != record["sha256"]:
        raise InputError(_CHANGED)
    with _ONE_AT_A_TIME:
        arrays = read_shard(path)
    found = check_arrays(arrays, path)[0]
    if found != rows:
        raise InputError(f"has {found} rows, the manifest says {rows}")
    for name, array in arrays.items():
        # Minimum and maximum are NaN if any value is.
        if not (np.isfinite(np.min(array)) and np.isfinite(np.max(array))):
            raise InputError(f"has NaN or infinite values in '{name}'")


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
        yield Fault(CONFIG_NAME, _CHANGED, _REPAIR)


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
                yield Fault(entry.file, TWICE, _REPAIR)
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
                yield Fault(entry.file, fault, _RESUME if fault in ABSENT else _REPAIR)


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
            faults.append(Fault(path.name, UNLISTED, "remove it"))
    if not faults and not dataset.manifest.get("complete"):
        hint = "run the same mbtf-gen command again, or mbtf-gen merge"
        faults.append(Fault(MANIFEST_NAME, INCOMPLETE, hint))
    return faults

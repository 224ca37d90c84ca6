"""Checks a folder of shards against its manifest and digests."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.documents import ABSENT, CHANGED, plan_digest, read_sidecar, repair_hint
from mbtf_core.data.folder import DataFolder, is_leftover, sidecar_name
from mbtf_core.data.schema import CONFIG_NAME, GEOMETRY_NAME, MANIFEST_NAME, ShardEntry
from mbtf_core.data.shard_files import check_arrays, check_values, read_shard
from mbtf_core.errors import InputError, reason
from mbtf_core.files.atomic import file_sha256

# The manifest only lacks its completion.
INCOMPLETE = "is not complete"
# A fault of the manifest, not of the shard that it names.
TWICE = "is listed twice"
_RESUME = "run the same mbtf-gen command again: it renders the missing shards"

# The reader of EXR files redirects the standard error stream of the whole process. NumPy parses headers with
# `ast`, which may fail in several threads before Python 3.11.8 and 3.12.2 (CPython issue 106905).
_ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class Fault:
    """One fault of a data set.

    Attributes
    ----------
    file : name of the file
    what : the fault, in words
    hint : what to do about it
    """

    file: str
    what: str
    hint: str


def examine(
    folder: DataFolder, entry: ShardEntry, config_hash: str
) -> tuple[dict[str, Any] | None, str | None]:
    """(sidecar, None) or (None, fault) of a shard, whose whole file is read."""
    try:
        record = read_sidecar(folder, entry, config_hash)
        with folder.fresh(entry.file) as file:
            _check_content(file, entry.rows, record)
        return record, None
    except InputError as error:
        return None, error.what
    except (KeyError, OSError) as error:
        return None, f"cannot be checked ({reason(error)})"


def _check_content(path: Path, rows: int, record: dict[str, Any]) -> None:
    """An InputError where the bytes or values of a shard are at fault."""
    if file_sha256(path) != record["sha256"]:
        raise InputError(CHANGED)
    with _ONE_AT_A_TIME:
        arrays = read_shard(path)
    found = check_arrays(arrays, path)[0]
    if found != rows:
        raise InputError(f"has {found} rows, the manifest says {rows}")
    check_values(arrays, path)


def document_faults(folder: DataFolder, manifest: Mapping[str, Any]) -> Iterator[Fault]:
    """Faults of configuration and geometry, whose digests a manifest contains."""
    digests = {CONFIG_NAME: manifest.get("config_yaml")}
    if manifest["geometry"] is not None:
        digests[GEOMETRY_NAME] = manifest["geometry"]["sha256"]
    hint = repair_hint(folder)
    for name, digest in digests.items():
        if not folder.has(name):
            yield Fault(name, ABSENT[0], hint)
        elif hashlib.sha256(folder.read(name)).hexdigest() != digest:
            yield Fault(name, CHANGED, hint)


def shard_faults(
    folder: DataFolder, entries: Sequence[ShardEntry], config_hash: str, plan: str
) -> Iterator[Fault]:
    """Faults of the listed shards, read by several threads; `plan` is the digest of the run plan that all
    must have."""
    hint = repair_hint(folder)
    listed: set[str] = set()
    first: dict[str, str] = {}
    with ThreadPoolExecutor(max(2, os.cpu_count() or 1), "verify") as pool:
        examined = pool.map(lambda e: examine(folder, e, config_hash), entries)
        for entry, (record, fault) in zip(entries, examined, strict=True):
            if entry.file in listed:
                yield Fault(entry.file, TWICE, hint)
                continue
            listed.add(entry.file)
            if record is not None and record.get("plan") != plan:
                fault = "was rendered with another plan"
            elif record is not None:
                twin = first.setdefault(record["sha256"], entry.file)
                if twin != entry.file:
                    fault = f"has the same content as {twin}"
                    # Either of the two may be the copy.
                    yield Fault(twin, f"has the same content as {entry.file}", hint)
            if fault is not None:
                yield Fault(entry.file, fault, _RESUME if fault in ABSENT else hint)


def foreign_files(folder: DataFolder, entries: Iterable[ShardEntry]) -> list[str]:
    """Names in a folder that are no part of the data set with these shards; folders end with "/"."""
    own = {MANIFEST_NAME, CONFIG_NAME, GEOMETRY_NAME}
    for entry in entries:
        own |= {entry.file, sidecar_name(entry.file)}
    return [name for name in folder.names() if name not in own and not is_leftover(name)]


def verify(folder: str | Path | DataFolder) -> list[Fault]:
    """Find all faults of a data set: changed, truncated, missing or foreign shards, an unfinished manifest.

    Parameters
    ----------
    folder : the data set: a path or a URL

    Returns
    -------
    list of Fault
        Empty for an intact, complete data set. Files that the manifest does not list are no fault.

    Raises
    ------
    InputError : the folder contains no data set of this schema version, or its manifest is damaged
    PartialError : the store cannot be reached
    """
    folder = DataFolder.open(folder)
    dataset = Dataset.open(folder)
    faults = list(document_faults(folder, dataset.manifest))
    entries = [entry for split in dataset.splits for entry in dataset.entries(split)]
    faults += shard_faults(folder, entries, dataset.manifest["config_hash"], plan_digest(dataset.manifest))
    if not faults and not dataset.manifest.get("complete"):
        hint = "run the same mbtf-gen command again, or mbtf-gen merge"
        faults.append(Fault(MANIFEST_NAME, INCOMPLETE, hint))
    return faults

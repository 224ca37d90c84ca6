"""Sidecars: the JSON file beside each shard, which marks it as finished and says what it belongs to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mbtf_core.data.schema import FORMAT_NAME, MANIFEST_NAME, SPLITS, ShardEntry
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_checksummed

# Faults of shards that are not rendered yet; an interrupted run leaves many of them.
ABSENT = ("is missing", "is unfinished (no sidecar)")
# A file whose bytes are not those that were written.
CHANGED = "has changed since it was written (SHA-256 differs)"


def repair_hint(folder: Path) -> str:
    """What to do about a data set whose manifest is lost or damaged."""
    return f"repair it with: mbtf-gen repair {folder}"


def sidecar_of(shard: Path) -> Path:
    """The JSON file beside a shard. It is written last and marks the shard as finished."""
    return shard.with_suffix(".json")


def sidecars(folder: Path) -> list[Path]:
    """Sidecars in a folder, by their names."""
    return sorted(path for split in SPLITS for path in folder.glob(f"{split}-*.json"))


def read_sidecar(folder: Path, entry: ShardEntry, config_hash: str) -> dict[str, Any]:
    """Sidecar of a finished shard, whose bytes are not read.

    Raises
    ------
    InputError : the shard is not finished, has another size, or is not what the manifest lists
    """
    path = folder / entry.file
    sidecar = sidecar_of(path)
    for file, fault in zip((path, sidecar), ABSENT, strict=True):
        if not file.exists():
            raise InputError(fault, where=path)
    try:
        record = read_checksummed(sidecar)
    except InputError as error:
        raise InputError(f"has a corrupt sidecar: {error.what}", where=path) from None
    found = {key: record.get(key) for key in ("split", "index", "rows", "bytes")}
    fault = ""
    if record.get("format") != FORMAT_NAME or record.get("config_hash") != config_hash:
        fault = f"belongs to another data set than {MANIFEST_NAME}"
    elif record.get("file") != entry.file:
        fault = f"has the sidecar of {record.get('file')}"
    elif (found["split"], found["index"]) != (entry.split, entry.index):
        listed = f"{MANIFEST_NAME} lists it as {entry.split} {entry.index}"
        fault = f"is shard {found['split']} {found['index']}, {listed}"
    elif found["rows"] != entry.rows:
        fault = f"has {found['rows']} rows, {MANIFEST_NAME} says {entry.rows}"
    elif found["bytes"] != path.stat().st_size:
        fault = f"has {path.stat().st_size} bytes, its sidecar says {found['bytes']}"
    if fault:
        raise InputError(fault, where=path)
    return record


def finished_record(folder: Path, entry: ShardEntry, config_hash: str) -> dict[str, Any] | None:
    """Sidecar of a shard that is finished by its sidecar and size (its bytes are not read), or None."""
    try:
        return read_sidecar(folder, entry, config_hash)
    except (InputError, OSError):
        return None

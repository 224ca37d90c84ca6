"""Sidecars: the JSON file beside each shard, which marks it as finished and says what it belongs to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from mbtf_core.data.folder import DataFolder, sidecar_name
from mbtf_core.data.schema import FORMAT_NAME, MANIFEST_NAME, SCHEMA_VERSION, ShardEntry
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import Stored

# Faults of shards that are not rendered yet; an interrupted run leaves many of them.
ABSENT = ("is missing", "is unfinished (no sidecar)")
# A file whose bytes are not those that were written.
CHANGED = "has changed since it was written (SHA-256 differs)"


def repair_hint(folder: object) -> str:
    """What to do about a data set whose manifest is lost or damaged."""
    return f"repair it with: mbtf-gen repair {folder}"


def read_sidecar(folder: DataFolder, entry: ShardEntry, config_hash: str) -> dict[str, Any]:
    """Sidecar of a finished shard, whose bytes are not read.

    Raises
    ------
    InputError : the shard is not finished, has another size, or is not what the manifest lists
    """
    where, sidecar, size = folder.at(entry.file), sidecar_name(entry.file), folder.size(entry.file)
    for missing, fault in zip((size is None, not folder.has(sidecar)), ABSENT, strict=True):
        if missing:
            raise InputError(fault, where=where)
    try:
        record = folder.read_checksummed(sidecar)
    except InputError as error:
        raise InputError(f"has a corrupt sidecar: {error.what}", where=where) from None
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
    elif found["bytes"] != size:
        fault = f"has {size} bytes, its sidecar says {found['bytes']}"
    if fault:
        raise InputError(fault, where=where)
    return record


def finished_record(folder: DataFolder, entry: ShardEntry, config_hash: str) -> dict[str, Any] | None:
    """Sidecar of a shard that is finished by its sidecar and size (its bytes are not read), or None."""
    try:
        return read_sidecar(folder, entry, config_hash)
    except (InputError, OSError):
        return None


def sidecar(
    entry: ShardEntry,
    stored: Stored,
    *,
    config_hash: str,
    plan: str,
    seed: int,
    spp: int | None,
    queries: int,
    paths: int,
    seconds: float,
    quarantined: dict[str, Any],
    target: dict[str, Any] | None,
    mean_value: list[float],
    mean_variance: list[float] | None,
) -> dict[str, Any]:
    """Content of the sidecar of a shard.

    Parameters
    ----------
    stored : size and digest of the shard's file
    config_hash, plan : digests of the configuration and of the run plan
    seed : root seed
    spp : planned paths of a query; None of measured values
    queries, paths, seconds : number of queries, paths traced, duration of the rendering
    quarantined : samples that are not stored
    target : error reached under a target error
    mean_value, mean_variance : over the queries, by channel; no variance of measured values
    """
    return {
        "format": FORMAT_NAME,
        "schema": SCHEMA_VERSION,
        "config_hash": config_hash,
        "plan": plan,
        **{key: getattr(entry, key) for key in ("file", "split", "index", "rows")},
        **asdict(stored),
        "seed": {"root": seed, "split": entry.split, "shard": entry.index},
        "spp": spp,
        "queries": queries,
        "paths": paths,
        "seconds": seconds,
        "quarantined": quarantined,
        "target": target,
        "statistics": {"mean_value": mean_value, "mean_variance": mean_variance},
    }


def upload_waiting(
    folder: DataFolder, entries: Sequence[ShardEntry], config_hash: str, plan: str
) -> list[str]:
    """Upload the shards that earlier runs could not upload and that the data set lacks.

    Parameters
    ----------
    entries : all shards of the data set
    config_hash, plan : digests of configuration and run plan that the shards must have

    Returns
    -------
    list of str
        Files that were uploaded.

    Raises
    ------
    PartialError : the store cannot be reached; the shards are kept
    """
    known = {entry.file: entry for entry in entries}

    def is_lacking(record: dict[str, Any]) -> bool:
        entry = known.get(str(record.get("file")))
        same = (record.get("config_hash"), record.get("plan")) == (config_hash, plan)
        if entry is None or not same or record.get("rows") != entry.rows:
            return False
        return finished_record(folder, entry, config_hash) is None

    return folder.upload_waiting(is_lacking)

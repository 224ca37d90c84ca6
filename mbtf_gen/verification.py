"""Checks a folder of shards against its manifest and digests."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .atomic import digest, read_json
from .dataset import Dataset
from .errors import InputError, MbtfError
from .schema import FORMAT_NAME, MANIFEST_NAME
from .shard_files import check_arrays, read_shard

# What is said of a shard that is not there yet; an interrupted run leaves many of them.
_ABSENT = ("is missing", "is unfinished (no sidecar)")
_MAKE = "run the same mbtf-gen command again: it makes what is missing"
_REMAKE = "remove it and run the same mbtf-gen command again"


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong: the file, what it is, and what to do about it."""

    file: str
    what: str
    cure: str

    @property
    def absent(self) -> bool:
        """Whether the file is only not there yet."""
        return self.what in _ABSENT


def sidecar_of(shard: Path) -> Path:
    """The JSON file beside a shard; it is written last and makes the shard count as finished."""
    return shard.with_suffix(".json")


def shard_fault(path: Path, rows: int, config_hash: str, *, digests: bool = True) -> str | None:
    """What is wrong with one shard, or None.

    Parameters
    ----------
    rows : queries (or buffers) it must hold
    digests : also read the whole file and compare its SHA-256; else only sizes
    """
    sidecar = sidecar_of(path)
    if not path.exists():
        return _ABSENT[0]
    if not sidecar.exists():
        return _ABSENT[1]
    try:
        record: dict[str, Any] = read_json(sidecar)
        if record.get("format") != FORMAT_NAME or record.get("config_hash") != config_hash:
            return "belongs to another data set"
        if record.get("file") != path.name:
            return f"has the sidecar of {record.get('file')}"
        if record["rows"] != rows:
            return f"holds {record['rows']} rows, the manifest says {rows}"
        if path.stat().st_size != record["bytes"]:
            return f"has {path.stat().st_size} bytes, its sidecar says {record['bytes']}"
        if digests and digest(path) != record["sha256"]:
            return "has changed since it was written (SHA-256 differs)"
        if digests:
            arrays = read_shard(path)
            if check_arrays(arrays, path)[0] != rows:
                return f"holds {check_arrays(arrays, path)[0]} rows, the manifest says {rows}"
            for name, array in arrays.items():
                if not np.isfinite(array).all():
                    return f"holds NaN or infinite numbers in '{name}'"
    except InputError as error:
        return error.what
    except (KeyError, OSError) as error:
        return f"cannot be checked ({error})"
    return None


def verify(folder: Path) -> list[Fault]:
    """All faults of a data set: flipped bytes, truncated, missing or foreign shards, an unfinished manifest.

    Raises
    ------
    InputError : the folder holds no data set of this schema
    """
    dataset = Dataset.open(folder)
    faults: list[Fault] = []
    listed: set[str] = set()
    digests: dict[str, str] = {}
    for split in dataset.splits:
        for entry in dataset.manifest["splits"][split]["shards"]:
            path = folder / entry["file"]
            if path.name in listed:
                faults.append(Fault(path.name, "is listed twice", "generate the data set again"))
            listed.update({path.name, sidecar_of(path).name})
            wanted = entry["rows"], dataset.manifest["config_hash"]
            fault = shard_fault(path, *wanted)
            if fault is None:
                twin = digests.setdefault(read_json(sidecar_of(path))["sha256"], path.name)
                fault = f"has the same content as {twin}" if twin != path.name else None
            if fault is not None:
                # What passes for finished is not made again by itself.
                cure = _REMAKE if is_finished(path, *wanted) else _MAKE
                faults.append(Fault(path.name, fault, cure))
    for path in sorted(folder.iterdir()):
        if path.suffix in (".npz", ".exr") and path.name not in listed:
            faults.append(Fault(path.name, "is not listed in the manifest", "remove it"))
    if not faults and not dataset.manifest.get("complete"):
        cure = "run the same mbtf-gen command again, or mbtf-gen merge"
        faults.append(Fault(MANIFEST_NAME, "is not complete", cure))
    return faults


def is_finished(path: Path, rows: int, config_hash: str) -> bool:
    """Whether a shard is complete by its sidecar and size (its bytes are not read)."""
    try:
        return shard_fault(path, rows, config_hash, digests=False) is None
    except MbtfError:
        return False

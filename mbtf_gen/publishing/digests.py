"""Digests of the arrays of a data set: what a remade data set, or one in another file format, must equal.

The digest of an array is the SHA-256 of its numbers as little-endian float32 in C order, without a header. It
does not depend on the file format.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from mbtf_core.config.settings import check_document
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.documents import software_versions
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_json

DIGESTS_NAME = "digests.json"
_FORMAT, _VERSION = "mbtf-digests", 1
# Arrays whose bits depend on no machine.
_QUERIES = ("u", "sigma", "omega_i", "omega_o")


class _Digests(BaseModel):
    """Keys of ``digests.json`` that a comparison needs."""

    config_hash: str
    software: dict[str, str]
    arrays: dict[str, dict[str, str]]
    geometry: str | None


def array_sha256(array: NDArray[np.float32]) -> str:
    """SHA-256 of an array's numbers, hexadecimal."""
    return hashlib.sha256(np.ascontiguousarray(array, "<f4").data).hexdigest()


def dataset_digests(data: Dataset) -> dict[str, Any]:
    """Digests of all arrays of a data set, as plain data.

    Parameters
    ----------
    data : Dataset
        A complete data set.

    Returns
    -------
    dict
        ``arrays``: shard → array → SHA-256; ``geometry``: SHA-256 of ``geometry.exr`` or None;
        ``config_hash``; ``software``: the versions that the numbers depend on.

    Raises
    ------
    InputError
        A shard cannot be read.
    """
    return {
        "format": _FORMAT,
        "version": _VERSION,
        "config_hash": data.manifest["config_hash"],
        "software": data.manifest["software"],
        "geometry": (data.manifest["geometry"] or {}).get("sha256"),
        "arrays": {
            shard.file.rpartition(".")[0]: {name: array_sha256(array) for name, array in shard.read().items()}
            for split in data.splits
            for shard in data.shards(split)
        },
    }


def digest_faults(data: Dataset, path: Path) -> list[str]:
    """Differences between a data set and published digests, in words; empty where every bit is equal.

    Parameters
    ----------
    data : Dataset
        The data set that was made again.
    path : Path
        ``digests.json`` of the published one.

    Raises
    ------
    InputError
        The file or a shard cannot be read.
    """
    published = read_json(path)
    if [published.get(key) for key in ("format", "version")] != [_FORMAT, _VERSION]:
        raise InputError("holds no digests of arrays", where=path, hint=f"name a {DIGESTS_NAME} of a recipe")
    check_document(_Digests, published, path, "download it again")
    found = dataset_digests(data)
    if found["config_hash"] != published["config_hash"]:
        return ["belongs to another configuration, or was made from other maps"]
    faults = _array_faults(found["arrays"], published["arrays"])
    if found["geometry"] != published["geometry"]:
        faults.append("geometry.exr differs")
    return faults and [*faults, *_reasons(faults, published["software"])]


def _array_faults(
    found: Mapping[str, Mapping[str, str]], published: Mapping[str, Mapping[str, str]]
) -> list[str]:
    lines = []
    for name in sorted({arrays for shard in published.values() for arrays in shard}):
        shards = [s for s in sorted({*found, *published}) if _get(found, s, name) != _get(published, s, name)]
        if shards:
            lines.append(f"{name} differs in {len(shards)} of {len(published)} shards, first {shards[0]}")
    return lines


def _get(arrays: Mapping[str, Mapping[str, str]], shard: str, name: str) -> str | None:
    return arrays.get(shard, {}).get(name)


def _reasons(faults: list[str], published: Mapping[str, str]) -> list[str]:
    """Other software or another type of machine, which explains other values but no other queries."""
    if any(fault.split()[0] in _QUERIES for fault in faults):
        return ["queries are equal on every machine: this is another data set"]
    here = software_versions()
    other = [f"{k} {published[k]} -> {here.get(k)}" for k in sorted(published) if published[k] != here.get(k)]
    why = "; ".join(other) or "the processor may be of another type"
    return [f"values are equal on one type of machine with the same software ({why})"]

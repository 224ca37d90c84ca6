"""Digests of the arrays of a data set: what a remade data set, or one in another file format, must equal.

The digest of an array is the SHA-256 of its numbers as little-endian float32 in C order, without a header. It
does not depend on the file format.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel

from mbtf_core.config.settings import check_document
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.documents import software_versions
from mbtf_core.data.shard_files import Arrays
from mbtf_core.files.atomic import read_json

DIGESTS_NAME = "digests.json"
# Arrays whose bits depend on no machine.
_QUERIES = ("u", "sigma", "omega_i", "omega_o")


class Digests(BaseModel):
    """Content of ``digests.json``.

    Attributes
    ----------
    config_hash, software : of the manifest: what the numbers depend on
    geometry : SHA-256 of ``geometry.exr``, or None
    arrays : shard → array → SHA-256
    """

    format: Literal["mbtf-digests"] = "mbtf-digests"
    version: Literal[1] = 1
    config_hash: str
    software: dict[str, str]
    geometry: str | None
    arrays: dict[str, dict[str, str]]

    @classmethod
    def of(cls, data: Dataset, arrays: Mapping[str, Mapping[str, str]]) -> Digests:
        """Digests of a data set whose arrays have these."""
        manifest = data.manifest
        stored = {key: manifest[key] for key in ("config_hash", "software")}
        geometry = (manifest["geometry"] or {}).get("sha256")
        return cls.model_validate({**stored, "geometry": geometry, "arrays": arrays})

    @property
    def content(self) -> bytes:
        """The file."""
        return f"{self.model_dump_json(indent=2)}\n".encode()


def array_digests(arrays: Arrays) -> dict[str, str]:
    """SHA-256 of each array's numbers, hexadecimal."""
    return {
        name: hashlib.sha256(np.ascontiguousarray(array, "<f4").data).hexdigest()
        for name, array in arrays.items()
    }


def digest_faults(data: Dataset, path: Path) -> list[str]:
    """Differences between a data set and published digests, in words; empty where every bit is equal.

    Parameters
    ----------
    data : the data set that was made again
    path : ``digests.json`` of the published one

    Raises
    ------
    InputError : the file or a shard cannot be read
    """
    hint = f"name a {DIGESTS_NAME} of a recipe"
    document = read_json(path, hint)
    check_document(Digests, document, path, hint)
    published = Digests.model_validate(document)
    if data.manifest["config_hash"] != published.config_hash:
        return ["belongs to another configuration, or was made from other maps"]
    shards = [shard for split in data.splits for shard in data.shards(split)]
    found = {shard.file.rpartition(".")[0]: array_digests(shard.read()) for shard in shards}
    faults = []
    for name in sorted({array for shard in published.arrays.values() for array in shard}):
        other = [
            stem
            for stem in sorted({*found, *published.arrays})
            if found.get(stem, {}).get(name) != published.arrays.get(stem, {}).get(name)
        ]
        if other:
            faults.append(
                f"{name} differs in {len(other)} of {len(published.arrays)} shards, first {other[0]}"
            )
            if name in _QUERIES:
                return [*faults, "queries are equal on every machine: this is another data set"]
    if Digests.of(data, found).geometry != published.geometry:
        faults.append("geometry.exr differs")
    if not faults:
        return []
    here, software = software_versions(), published.software
    changed = [f"{k} {v} -> {here.get(k)}" for k, v in sorted(software.items()) if v != here.get(k)]
    why = "; ".join(changed) or "the processor may be of another type"
    return [*faults, f"values are equal on one type of machine with the same software ({why})"]

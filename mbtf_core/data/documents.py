"""The documents of a data set: its manifest, and the sidecar beside each shard.

A sidecar marks its shard as finished and states what it belongs to.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, Field, model_validator

from mbtf_core.config.settings import check_document
from mbtf_core.data.folder import DataFolder, sidecar_name
from mbtf_core.data.lattice import MAX_LEVEL
from mbtf_core.data.schema import FORMAT_NAME, MANIFEST_NAME, SCHEMA_VERSION, Layout, ShardEntry
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import data_sha256

_Count = Annotated[int, Field(strict=True, ge=0, lt=1 << 40)]
_FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*\.(npz|exr)$", max_length=100)]
# Faults of shards that are not rendered yet; an interrupted run leaves many of them.
ABSENT = ("is missing", "is unfinished (no sidecar)")
# A file whose bytes are not those that were written.
CHANGED = "has changed since it was written (SHA-256 differs)"


class _Entry(BaseModel):
    file: _FileName
    rows: _Count


class _Split(BaseModel):
    shards: list[_Entry]
    lights_per_path: Annotated[int, Field(strict=True, ge=1)] = 1

    @model_validator(mode="after")
    def _whole_groups(self) -> Self:
        if any(entry.rows % self.lights_per_path for entry in self.shards):
            raise ValueError("rows must be multiples of lights_per_path")
        return self


class _Levels(BaseModel):
    finest: Annotated[int, Field(strict=True, ge=0, le=MAX_LEVEL)]


class _Tile(BaseModel):
    aspect: float = Field(gt=0, le=1e6, allow_inf_nan=False)


class _Geometry(BaseModel):
    file: Literal["geometry.exr"]
    sha256: str


class Manifest(BaseModel):
    """Keys of a manifest that readers need; others are ignored."""

    config_hash: str
    layout: Layout
    levels: _Levels
    tile: _Tile
    splits: dict[str, _Split]
    geometry: _Geometry | None
    patch_size: _Count | None = None
    slice_size: _Count | None = None
    estimates: Literal[1, 2] = 2


@dataclass(frozen=True)
class BadSample:
    """A non-finite sample: number of its query in the shard, and the effect that caused it (``direct light``
    or ``interreflection``)."""

    query: int
    effect: str


@dataclass(frozen=True)
class TargetReached:
    """Error of a batch of queries under a target error; errors are relative to max(value, tile mean).

    Attributes
    ----------
    queries, missed : number of queries, and of those that needed more paths than the cap
    worst : largest error of a missed query that the pilot predicts; 0 without missed queries
    square : mean square of the relative error, from the stored halves
    """

    queries: int
    missed: int
    worst: float
    square: float


class Statistics(BaseModel, allow_inf_nan=False):
    """Means over the queries of a shard, by channel; measured values have no variance."""

    mean_value: tuple[float, float, float]
    mean_variance: tuple[float, float, float] | None


class Quarantined(BaseModel):
    """Samples that are not stored."""

    nonfinite_samples: int = 0
    lost_rays: int = 0
    capped_rays: int = 0
    nonfinite_at: list[BadSample] = []


class Sidecar(BaseModel, allow_inf_nan=False):
    """Content of the sidecar of a shard.

    Attributes
    ----------
    config_hash, plan : digests of the configuration and of the run plan
    file, split, index, rows : as the manifest lists the shard
    bytes, sha256 : of the shard's file
    seed : root seed, split and shard that the random numbers follow from
    spp : planned paths of a query; None of measured values
    queries, paths, seconds : number of queries, paths traced, duration of the rendering
    target : error reached under a target error
    """

    config_hash: str
    plan: str
    file: str
    split: str
    index: int
    rows: int
    bytes: int
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    seed: dict[str, int | str]
    spp: int | None
    queries: int
    paths: int
    seconds: float
    quarantined: Quarantined
    target: TargetReached | None
    statistics: Statistics

    def as_dict(self) -> dict[str, Any]:
        """The document, without its checksum."""
        return {"format": FORMAT_NAME, "schema": SCHEMA_VERSION, **self.model_dump()}


def software_versions(*names: str) -> dict[str, str]:
    """Versions of the packages `names`, by default of those that the values of a data set depend on."""
    out = {"python": platform.python_version(), "machine": platform.machine()}
    for name in names or ("mbtf", "mitsuba", "drjit", "numpy", "trimesh"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            out[name] = "not installed"
    return out


def plan_digest(manifest: Mapping[str, Any]) -> str:
    """SHA-256 of what the run plan in a manifest decides, hexadecimal. The sidecars of all shards repeat it.

    Explanations and bias bounds are left out: they decide nothing, and other versions word them differently.
    """
    # Measured data have no plan.
    plan = manifest.get("effects") or {}
    decided = {key: plan.get(key) for key in ("max_depth", "roulette_depth", "closed_form")}
    on = sorted(effect["name"] for effect in plan.get("effects", []) if effect["on"])
    pilots = {key: manifest.get(key) for key in ("allocation", "highlights")}
    return data_sha256({**decided, "effects": on, **pilots})


def read_manifest(folder: str | Path | DataFolder) -> dict[str, Any]:
    """The manifest of a folder; an InputError unless it is exactly as it was written."""
    found = folder if isinstance(folder, DataFolder) else DataFolder.open(folder)
    return found.read_checksummed(MANIFEST_NAME, repair_hint(found))


def repair_hint(folder: object) -> str:
    """What to do about a data set whose manifest is lost or damaged."""
    return f"repair it with: mbtf-gen repair {folder}"


def read_sidecar(folder: DataFolder, entry: ShardEntry, config_hash: str) -> dict[str, Any]:
    """Sidecar of a finished shard, whose bytes are not read; an InputError where the shard is not finished,
    has another size, or is not what the manifest lists."""
    where, sidecar, size = folder.at(entry.file), sidecar_name(entry.file), folder.size(entry.file)
    for missing, fault in zip((size is None, not folder.has(sidecar)), ABSENT, strict=True):
        if missing:
            raise InputError(fault, where=where)
    try:
        record = folder.read_checksummed(sidecar)
        check_document(Sidecar, record, folder.at(sidecar), "")
    except InputError as error:
        raise InputError(f"has a corrupt sidecar: {error.what}", where=where) from None
    if record.get("format") != FORMAT_NAME or record.get("config_hash") != config_hash:
        raise InputError(f"belongs to another data set than {MANIFEST_NAME}", where=where)
    if record.get("file") != entry.file:
        raise InputError(f"has the sidecar of {record.get('file')}", where=where)
    for key, listed in (("split", entry.split), ("index", entry.index), ("rows", entry.rows)):
        if record.get(key) != listed:
            what = f"has the {key} {record.get(key)}, {MANIFEST_NAME} says {listed}"
            raise InputError(what, where=where)
    if record.get("bytes") != size:
        raise InputError(f"has {size} bytes, its sidecar says {record.get('bytes')}", where=where)
    return record


def finished_record(folder: DataFolder, entry: ShardEntry, config_hash: str) -> dict[str, Any] | None:
    """Sidecar of a shard that is finished by its sidecar and size (its bytes are not read), or None."""
    try:
        return read_sidecar(folder, entry, config_hash)
    except (InputError, OSError):
        return None


def upload_waiting(
    folder: DataFolder, entries: Sequence[ShardEntry], config_hash: str, plan: str
) -> list[str]:
    """Upload the shards that earlier runs could not upload and that the data set lacks; returns their names.
    Shards must be among `entries`, and have these digests of configuration and run plan. A PartialError where
    the store cannot be reached; the shards are kept."""
    known = {entry.file: entry for entry in entries}

    def is_lacking(record: dict[str, Any]) -> bool:
        entry = known.get(str(record.get("file")))
        same = (record.get("config_hash"), record.get("plan")) == (config_hash, plan)
        if entry is None or not same or record.get("rows") != entry.rows:
            return False
        return finished_record(folder, entry, config_hash) is None

    return folder.upload_waiting(is_lacking)

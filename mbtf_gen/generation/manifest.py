"""The manifest of a data set: its contents, how it was generated, and the meaning of its numbers.

It is written without shards and completed when all are finished.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pydantic import BaseModel, field_validator

from mbtf_core.config.settings import check_document
from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.documents import finished_record, read_manifest, software_versions
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.lattice import Lattice, sigma_of_level
from mbtf_core.data.schema import (
    ARRAYS,
    CONVENTIONS,
    FORMAT_NAME,
    LEADING_AXES,
    MANIFEST_NAME,
    SCHEMA_VERSION,
    SPLITS,
    Layout,
    ShardEntry,
)
from mbtf_core.files.atomic import checksummed
from mbtf_core.files.locks import brief_lock
from mbtf_gen.config.exchange import ImportConfig
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.shard_record import ShardStatistics
from mbtf_gen.planning.effects import EFFECTS
from mbtf_gen.planning.effects_plan import EffectsPlan
from mbtf_gen.planning.highlights import Highlights
from mbtf_gen.planning.job import Job, split_lights, split_queries, split_spp
from mbtf_gen.planning.run_plan import RunPlan
from mbtf_gen.planning.sample_allocation import Allocation


class DataSource(Protocol):
    """What becomes a data set: a job, or an import."""

    @property
    def config(self) -> GeneratorConfig | ImportConfig: ...

    @property
    def config_hash(self) -> str: ...

    @property
    def inputs(self) -> Mapping[str, str]: ...

    @property
    def lattice(self) -> Lattice: ...


def new_manifest(
    source: DataSource,
    *,
    arrays: Mapping[str, str],
    splits: Mapping[str, dict[str, Any]],
    entries: Sequence[ShardEntry],
    layout: Layout = "shuffled",
    **others: Any,
) -> dict[str, Any]:
    """Manifest of a data set without shards (``complete`` is false).

    Parameters
    ----------
    arrays : stored arrays, and their meanings where those of the schema do not apply
    splits : what is stated of each split besides its shards
    others : further keys, or other values of some
    """
    config, lattice = source.config.model_dump(mode="json"), source.lattice
    return {
        "format": FORMAT_NAME,
        "schema": SCHEMA_VERSION,
        "complete": False,
        "config_hash": source.config_hash,
        "config": config,
        "config_yaml": hashlib.sha256(dump_yaml(config).encode()).hexdigest(),
        "inputs": dict(sorted(source.inputs.items())),
        "conventions": CONVENTIONS,
        "tile": {"aspect": lattice.aspect},
        "levels": {
            "finest": lattice.finest,
            "shape": list(lattice.shape()),
            "sigma_finest": float(sigma_of_level(lattice.finest)),
        },
        "layout": layout,
        "patch_size": None,
        "slice_size": None,
        "array_format": source.config.output.format,
        "arrays": {
            a.name: {
                "shape": [*LEADING_AXES[layout], *a.trailing],
                "unit": a.unit,
                "meaning": arrays[a.name] or a.meaning,
            }
            for a in ARRAYS
            if a.name in arrays
        },
        "splits": {
            split: {
                **stated,
                "shards": [{"file": e.file, "rows": e.rows} for e in entries if e.split == split],
            }
            for split, stated in splits.items()
        },
        "software": software_versions(),
        "summary": None,
        **others,
    }


def build_manifest(job: Job, plan: RunPlan, geometry: Mapping[str, Any]) -> dict[str, Any]:
    """Manifest of a job's data set without shards; `geometry` is its key of that name."""
    tile, queries = job.material, job.query_plan
    optional = {"transmittance": plan.effects.on("opacity"), "weight": plan.highlights is not None}
    stored = [a.name for a in ARRAYS if optional.get(a.name, True)]
    found = new_manifest(
        job,
        arrays=dict.fromkeys(stored, ""),
        splits={
            split: {
                "queries": split_queries(job, split),
                "spp": split_spp(job.config, split),
                "lights_per_path": split_lights(job.config, split),
            }
            for split in SPLITS
        },
        entries=job.shards,
        layout=queries.layout,
        patch_size=queries.patch_size,
        slice_size=None if queries.directions is None else len(queries.directions) ** 2,
        geometry=dict(geometry),
        **plan.to_manifest(),
    )
    found["tile"] |= {**tile.properties(), "displacement_range": tile.thickness}
    found["levels"]["mixture"] = vars(queries.mixture)
    return found


class _Plan(BaseModel, allow_inf_nan=False):
    """Keys of a manifest that a run needs, besides those that readers need."""

    complete: bool
    effects: EffectsPlan
    allocation: Allocation | None
    highlights: Highlights | None

    @field_validator("effects")
    @classmethod
    def _lists_all(cls, plan: EffectsPlan) -> EffectsPlan:
        if [e.name for e in plan.effects] != list(EFFECTS):
            raise ValueError("must list all effects")
        return plan


def stored_plan(manifest: Mapping[str, Any], path: object) -> RunPlan:
    """The run plan in a manifest, of the file `path`; an InputError where that is corrupt."""
    found = check_document(_Plan, manifest, path, "check the data set with: mbtf-gen verify")
    return RunPlan(found.effects, found.allocation, found.highlights)


@dataclass(frozen=True)
class Summary:
    """Summary of a data set and of the run that ended.

    Attributes
    ----------
    folder : the data set
    complete : whether all shards of the manifest are finished
    queries, splits : queries in finished shards: of all splits, and by split
    paths, seconds, paths_per_second : paths traced in this run, its duration, their ratio
    shard_seconds : rendering time of all finished shards, over all runs
    relative_error : pooled relative standard error of the training values, √(mean variance) / mean value;
        None where their noise is unknown
    mean_value : mean training value per channel, 1/sr
    lost, capped, nonfinite : rays that slipped through the surface, rays cut at the cap on tile crossings,
        and non-finite samples that were sampled again, over all shards
    effects : effects that are simulated, in words
    target : under a target error, the RMS error ``reached``, the number of queries that ``missed`` it, their
        ``share``, and the ``worst`` error among them
    measured : whether the values are measured, not rendered
    """

    folder: str
    complete: bool
    queries: int
    splits: dict[str, int]
    paths: int
    seconds: float
    paths_per_second: float
    shard_seconds: float
    relative_error: float | None
    mean_value: list[float]
    lost: int
    capped: int
    nonfinite: int
    effects: list[str]
    target: dict[str, float] | None
    measured: bool = False


def finish(folder: str | Path | DataFolder, *, paths: int = 0, seconds: float = 0.0) -> Summary:
    """Complete the manifest if every shard is finished, and summarize (``mbtf-gen merge``).

    Raises
    ------
    InputError : no data set, or a corrupt manifest or sidecar
    PartialError : too many non-finite samples, or the folder cannot be written
    """
    folder = DataFolder.open(folder)
    dataset = Dataset.open(folder)
    manifest = read_manifest(folder)
    measured = "measured" in manifest
    effects = () if measured else stored_plan(manifest, folder.at(MANIFEST_NAME)).effects.effects
    totals, complete = ShardStatistics(), True
    for entry in (entry for split in dataset.splits for entry in dataset.entries(split)):
        record = finished_record(folder, entry, manifest["config_hash"])
        if record is None:
            complete = False
        else:
            totals.add(record)
    if complete:
        totals.refuse_nonfinite(totals.paths, folder)
    sums: dict[str, Any] = {
        "queries": totals.queries.total(),
        "shard_seconds": round(totals.seconds, 3),
        "relative_error": totals.relative_error(),
        "mean_value": totals.mean_value(),
        "target": totals.target(),
    }
    if complete and not manifest["complete"]:
        with brief_lock(folder.workspace / MANIFEST_NAME):
            # Another process may have completed it since.
            manifest = read_manifest(folder)
            if not manifest["complete"]:
                manifest |= {"complete": True, "software": software_versions()}
                manifest["summary"] = {**sums, "paths": totals.paths, **totals.counts}
                folder.write(MANIFEST_NAME, checksummed(manifest))
    if complete:
        folder.remove_leftovers()
    return Summary(
        folder=str(folder),
        complete=complete,
        splits={split: totals.queries[split] for split in manifest["splits"]},
        paths=paths,
        seconds=round(seconds, 3),
        paths_per_second=round(paths / seconds, 1) if seconds > 0 else 0.0,
        lost=totals.counts["lost_rays"],
        capped=totals.counts["capped_rays"],
        nonfinite=totals.counts["nonfinite_samples"],
        effects=[EFFECTS[e.name].description for e in effects if e.on],
        measured=measured,
        **sums,
    )

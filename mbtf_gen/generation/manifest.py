"""The manifest of a data set: its contents, how it was generated, and the meaning of its numbers."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, field_validator

from mbtf_core.config.settings import check_document
from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.documents import software_versions
from mbtf_core.data.lattice import sigma_of_level
from mbtf_core.data.schema import ARRAYS, CONVENTIONS, FORMAT_NAME, LEADING_AXES, SCHEMA_VERSION, SPLITS
from mbtf_gen.effects.catalog import EFFECTS
from mbtf_gen.effects.plan import EffectsPlan
from mbtf_gen.job import Job, split_queries, split_spp
from mbtf_gen.planning.run_plan import RunPlan
from mbtf_gen.planning.sample_allocation import Allocation


class _Plan(BaseModel, allow_inf_nan=False):
    """Keys of a manifest that a run needs, besides those that readers need."""

    complete: bool
    effects: EffectsPlan
    allocation: Allocation | None

    @field_validator("effects")
    @classmethod
    def _lists_all(cls, plan: EffectsPlan) -> EffectsPlan:
        if [e.name for e in plan.effects] != list(EFFECTS):
            raise ValueError("must list all effects")
        return plan


def stored_plan(manifest: Mapping[str, Any], path: object) -> RunPlan:
    """The run plan in a manifest, of the file `path`; an InputError where that is corrupt."""
    found = check_document(_Plan, manifest, path, "check the data set with: mbtf-gen verify")
    return RunPlan(found.effects, found.allocation)


def build_manifest(job: Job, plan: RunPlan, geometry: Mapping[str, Any] | None) -> dict[str, Any]:
    """Manifest of a data set without shards (``complete`` is false); `geometry` is its key of that name."""
    config, material, lattice = job.config, job.material, job.lattice
    plain = config.model_dump(mode="json")
    queries = job.query_plan
    return {
        "format": FORMAT_NAME,
        "schema": SCHEMA_VERSION,
        "complete": False,
        "config_hash": job.config_hash,
        "config": plain,
        "config_yaml": hashlib.sha256(dump_yaml(plain).encode()).hexdigest(),
        "inputs": dict(sorted(material.digests.items())),
        "conventions": CONVENTIONS,
        "tile": {
            "aspect": lattice.aspect,
            **job.material.properties(),
            "displacement_range": job.material.thickness,
        },
        "levels": {
            "finest": lattice.finest,
            "shape": list(lattice.shape()),
            "sigma_finest": float(sigma_of_level(lattice.finest)),
            "mixture": vars(queries.mixture),
        },
        "layout": queries.layout,
        "patch_size": queries.patch_size,
        "slice_size": None if queries.directions is None else len(queries.directions) ** 2,
        "array_format": config.output.format,
        "arrays": {
            a.name: {
                "shape": [*LEADING_AXES[queries.layout], *a.trailing],
                "unit": a.unit,
                "meaning": a.meaning,
            }
            for a in ARRAYS
            if a.name != "transmittance" or plan.effects.on("opacity")
        },
        "geometry": None if geometry is None else dict(geometry),
        **plan.to_manifest(),
        "splits": {
            split: {
                "queries": split_queries(job, split),
                "spp": split_spp(config, split),
                "shards": [{"file": e.file, "rows": e.rows} for e in job.shards if e.split == split],
            }
            for split in SPLITS
        },
        "software": software_versions(),
        "summary": None,
    }

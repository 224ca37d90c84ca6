"""The manifest of a data set: what it holds, how it was made, what the numbers mean."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from mbtf_core.config_file import dump_yaml
from mbtf_core.digest import data_sha256
from mbtf_core.lattice import sigma_of_level
from mbtf_core.shard_schema import ARRAYS, CONVENTIONS, FORMAT_NAME, SCHEMA_VERSION, SPLITS, Split
from mbtf_gen.planning.effects import EffectsPlan

if TYPE_CHECKING:
    from mbtf_gen.generation import Job


@dataclass(frozen=True)
class ShardEntry:
    """A shard to make: split, number within the split, file name, rows (queries or images)."""

    split: Split
    index: int
    file: str
    rows: int


def software_versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    return dict(_versions())


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    import platform
    from importlib.metadata import PackageNotFoundError, version

    out = {"python": platform.python_version(), "machine": platform.machine()}
    for name in ("mbtf", "mitsuba", "drjit", "numpy", "trimesh"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            out[name] = "not installed"
    return tuple(out.items())


def effects_digest(effects: Mapping[str, Any]) -> str:
    """SHA-256 of an effects plan as the manifest holds it, hexadecimal: sidecars name the plan by it."""
    return data_sha256(effects)


def build_manifest(job: Job, entries: list[ShardEntry], effects: EffectsPlan | None) -> dict[str, Any]:
    """Manifest of a data set that is about to be made (``complete`` is false); without effects where they
    are not known yet."""
    config, material, lattice = job.config, job.material, job.lattice
    plain = config.model_dump(mode="json")
    grid = job.grid
    plan = job.plan()
    rows, columns = lattice.shape()
    lead = ["n"] if plan.layout == "shuffled" else ["items", "rows", "columns"]
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
            "maps_shape": list(material.height.shape),
            "mesh_shape": list(grid.z.shape),
            "height_scale": material.height_scale
            if config.geometry.height_scale is None
            else config.geometry.height_scale,
            "displacement_range": grid.displacement_range,
        },
        "levels": {
            "finest": lattice.finest,
            "shape": [rows, columns],
            "sigma_finest": float(sigma_of_level(lattice.finest)),
            "mixture": {"log_uniform": plan.mixture.log_uniform, "finest": plan.mixture.finest},
        },
        "layout": plan.layout,
        "patch_size": plan.patch_size,
        "array_format": config.output.format,
        "arrays": {
            a.name: {"shape": [*lead, *a.trailing], "unit": a.unit, "meaning": a.meaning}
            for a in ARRAYS
            if not a.optional or (a.name == "transmittance" and effects is not None and effects.on("opacity"))
        },
        "effects": None if effects is None else effects.to_manifest(),
        "splits": {
            split: {
                "queries": sum(e.rows for e in entries if e.split == split) * job.places,
                "spp": job.spp(split),
                "shards": [{"file": e.file, "rows": e.rows} for e in entries if e.split == split],
            }
            for split in SPLITS
        },
        "software": software_versions(),
        "summary": None,
    }

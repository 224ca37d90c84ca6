"""What a folder of shards holds by now: its summary, and the completion of its manifest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field

from .atomic import read_json, write_json
from .dataset import Dataset
from .effects import EFFECTS, EffectsPlan
from .errors import PartialError
from .manifest import software_versions
from .schema import MANIFEST_NAME
from .settings import check_document
from .verification import is_finished, sidecar_of


@dataclass(frozen=True)
class Summary:
    """What a run made.

    Attributes
    ----------
    queries : finished, of all splits; splits : the same by split
    paths, seconds : traced in this run, and its duration
    relative_error : pooled relative standard error of the stored training values, √(mean variance) / mean
        value
    mean_value : mean training value per channel, 1/sr
    lost, capped, nonfinite : rays lost or capped, samples drawn again, over all shards
    """

    folder: str
    complete: bool
    queries: int
    splits: dict[str, int]
    paths: int
    seconds: float
    paths_per_second: float
    relative_error: float
    mean_value: list[float]
    lost: int
    capped: int
    nonfinite: int
    effects: list[str]


_Number = Annotated[float, Field(allow_inf_nan=False)]
_Colour = tuple[_Number, _Number, _Number]


class _Effect(BaseModel):
    name: Literal[tuple(EFFECTS)]  # type: ignore[valid-type]
    effect: str
    on: bool
    reason: str
    cost: _Number | None
    known: Literal["exact", "bound", "pilot", "asked"]
    error: _Number
    present: bool


class _Effects(BaseModel):
    mode: str
    tolerance: _Number
    max_depth: int
    cap_cost: _Number
    roulette_depth: int
    closed_form: bool
    effects: Annotated[list[_Effect], Field(min_length=len(EFFECTS), max_length=len(EFFECTS))]


class _Plan(BaseModel):
    """What :func:`finish` relies on of a manifest, beside what every reader does."""

    complete: bool
    effects: _Effects


class _Statistics(BaseModel):
    mean_value: _Colour
    mean_variance: _Colour


class _BadSample(BaseModel):
    query: int
    effect: str


class _Quarantined(BaseModel):
    nonfinite_samples: int
    nonfinite_at: list[_BadSample]
    lost_rays: int
    capped_rays: int


class _Made(BaseModel):
    """What :func:`finish` relies on of a shard's sidecar."""

    queries: Annotated[int, Field(ge=1)]
    paths: int
    seconds: _Number
    statistics: _Statistics
    quarantined: _Quarantined


# A run fails beyond this share of non-finite samples, but not for so few that chance may bring them: at one
# expected, more than four come once in three hundred runs.
NONFINITE_SHARE = 1e-6
NONFINITE_FEW = 4

_MEND = "look for damage with: mbtf-gen verify"


def planned_effects(folder: Path) -> EffectsPlan:
    """The effects plan of a data set's manifest.

    Raises
    ------
    InputError : a damaged manifest
    """
    manifest = read_json(folder / MANIFEST_NAME)
    check_document(_Plan, manifest, folder / MANIFEST_NAME, _MEND)
    return EffectsPlan.from_manifest(manifest["effects"])


def refuse_nonfinite(records: Sequence[Mapping[str, Any]], paths: int, folder: Path) -> None:
    """Refuse shards with more non-finite samples than a data set may have.

    Parameters
    ----------
    records : sidecars of shards
    paths : of the whole data set

    Raises
    ------
    PartialError : more than ``NONFINITE_FEW`` and more than ``NONFINITE_SHARE`` of the paths; says where
    """
    count = sum(r["quarantined"]["nonfinite_samples"] for r in records)
    if count <= max(NONFINITE_FEW, NONFINITE_SHARE * paths):
        return
    where = [(r["file"], bad) for r in records for bad in r["quarantined"]["nonfinite_at"]]
    first = "; ".join(f"{file} query {bad['query']}, {bad['effect']}" for file, bad in where[:3])
    raise PartialError(
        f"{count} of {paths} samples were NaN or infinite, more than 1 in 10⁶: {first}",
        where=folder,
        cure="check the material's values, then run again with --overwrite",
    )


def finish(folder: str | Path, *, paths: int = 0, seconds: float = 0.0) -> Summary:
    """Complete the manifest when every shard is there, and summarise (``mbtf-gen merge``).

    Raises
    ------
    InputError : no data set there, or damaged documents
    PartialError : too many non-finite samples
    """
    folder = Path(folder)
    manifest = Dataset.open(folder).manifest
    check_document(_Plan, manifest, folder / MANIFEST_NAME, _MEND)
    records: dict[str, list[dict[str, Any]]] = {}
    complete = True
    for split, content in manifest["splits"].items():
        for entry in content["shards"]:
            if is_finished(folder / entry["file"], entry["rows"], manifest["config_hash"]):
                sidecar = sidecar_of(folder / entry["file"])
                record = read_json(sidecar)
                check_document(_Made, record, sidecar, _MEND)
                records.setdefault(split, []).append(record)
            else:
                complete = False
    flat = [r for rs in records.values() for r in rs]
    if complete:
        refuse_nonfinite(flat, sum(r["paths"] for r in flat), folder)
    train = records.get("train", [])
    weights = np.array([r["queries"] for r in train], np.float64)
    if len(train):
        mean = np.average([r["statistics"]["mean_value"] for r in train], axis=0, weights=weights)
        variance = np.average([r["statistics"]["mean_variance"] for r in train], axis=0, weights=weights)
        relative = float(np.sqrt(variance.mean()) / mean.mean()) if mean.mean() > 0 else 0.0
    else:
        mean, relative = np.zeros(3), 0.0
    counts = {
        k: sum(r["quarantined"][k] for r in flat) for k in ("nonfinite_samples", "lost_rays", "capped_rays")
    }
    summary = Summary(
        folder=str(folder),
        complete=complete,
        queries=sum(r["queries"] for r in flat),
        splits={split: sum(r["queries"] for r in records.get(split, [])) for split in manifest["splits"]},
        paths=paths,
        seconds=round(seconds, 3),
        paths_per_second=round(paths / seconds, 1) if seconds > 0 else 0.0,
        relative_error=relative,
        mean_value=[float(m) for m in mean],
        lost=counts["lost_rays"],
        capped=counts["capped_rays"],
        nonfinite=counts["nonfinite_samples"],
        effects=[e["effect"] for e in manifest["effects"]["effects"] if e["on"]],
    )
    if complete and not manifest["complete"]:
        manifest["complete"] = True
        manifest["software"] = software_versions()
        manifest["summary"] = {
            "queries": summary.queries,
            "paths": sum(r["paths"] for r in flat),
            "shard_seconds": round(sum(r["seconds"] for r in flat), 3),
            "relative_error": summary.relative_error,
            "mean_value": summary.mean_value,
            **counts,
        }
        write_json(folder / MANIFEST_NAME, manifest)
    return summary


def summary_dict(summary: Summary) -> dict[str, Any]:
    """Summary as plain data for ``--json``."""
    return asdict(summary)

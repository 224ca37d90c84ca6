"""The summary of a data set, and the completion of its manifest."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field

from mbtf_core.atomic import write_checksummed
from mbtf_core.config_file import check_document
from mbtf_core.locks import brief_lock
from mbtf_core.shard_schema import MANIFEST_NAME
from mbtf_gen.config.effects_request import EFFECTS
from mbtf_gen.dataset.folder import read_manifest, remove_leftovers
from mbtf_gen.dataset.manifest import software_versions
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.shard_statistics import COUNTS, ShardStatistics, refuse_nonfinite
from mbtf_gen.dataset.verify import finished_record, sidecar_of
from mbtf_gen.planning.run_plan import RunPlan


@dataclass(frozen=True)
class Summary:
    """Summary of a data set and of the run that ended.

    Attributes
    ----------
    folder : str
        The data set.
    complete : bool
        Whether all shards of the manifest are finished.
    queries : int
        Queries in finished shards, of all splits.
    splits : dict of str to int
        The same by split.
    paths : int
        Paths traced in this run.
    seconds : float
        Duration of this run.
    paths_per_second : float
        Their ratio.
    writing_seconds : float
        Processor time of writing and digesting in this run, parallel to the rendering.
    waiting_seconds : float
        Time that rendering waited for the writer.
    shard_seconds : float
        Rendering time of all finished shards, over all runs.
    relative_error : float
        Pooled relative standard error of the training values, √(mean variance) / mean value.
    mean_value : list of float
        Mean training value per channel, 1/sr.
    lost, capped, nonfinite : int
        Rays that slipped through the surface, rays cut at the cap on tile crossings, and non-finite samples
        that were sampled again, over all shards.
    effects : list of str
        Effects that are simulated, in words.
    target : dict or None
        Under a target error: the RMS error ``reached``, the number of queries that ``missed`` it, their
        ``share``, and the ``worst`` error among them.
    """

    folder: str
    complete: bool
    queries: int
    splits: dict[str, int]
    paths: int
    seconds: float
    paths_per_second: float
    writing_seconds: float
    waiting_seconds: float
    shard_seconds: float
    relative_error: float
    mean_value: list[float]
    lost: int
    capped: int
    nonfinite: int
    effects: list[str]
    target: dict[str, float] | None


_Number = Annotated[float, Field(allow_inf_nan=False)]
_Color = tuple[_Number, _Number, _Number]


class _Effect(BaseModel):
    name: Literal[tuple(EFFECTS)]  # type: ignore[valid-type]
    on: bool
    reason: Literal["exact", "bound", "pilot", "forced"]
    explanation: str
    bias_bound: _Number | None
    error: _Number
    present: bool


class _Allocation(BaseModel):
    weights: list[_Number]
    typical: _Number
    scale: _Number
    gain: _Number
    mean_weights: list[_Number]


class _Target(BaseModel):
    queries: Annotated[int, Field(ge=1)]
    missed: int
    worst: _Number
    square: _Number


class _Effects(BaseModel):
    mode: str
    tolerance: _Number
    max_depth: int
    cap_bias_bound: _Number
    roulette_depth: int
    closed_form: bool
    effects: Annotated[list[_Effect], Field(min_length=len(EFFECTS), max_length=len(EFFECTS))]


class _Plan(BaseModel):
    """Keys of a manifest that :func:`finish` needs, besides those that readers need."""

    complete: bool
    effects: _Effects
    allocation: _Allocation | None


class _Statistics(BaseModel):
    mean_value: _Color
    mean_variance: _Color


class _BadSample(BaseModel):
    query: int
    effect: str


class _Quarantined(BaseModel):
    nonfinite_samples: int
    nonfinite_at: list[_BadSample]
    lost_rays: int
    capped_rays: int


class _Sidecar(BaseModel):
    """Keys of a sidecar that :func:`finish` needs."""

    split: str
    file: str
    queries: Annotated[int, Field(ge=1)]
    paths: int
    seconds: _Number
    statistics: _Statistics
    quarantined: _Quarantined
    target: _Target | None


_CHECK = "check the data set with: mbtf-gen verify"


def read_run_plan(folder: Path) -> RunPlan:
    """The run plan in a data set's manifest.

    Raises
    ------
    InputError : a corrupt manifest
    """
    manifest = read_manifest(folder)
    check_document(_Plan, manifest, folder / MANIFEST_NAME, _CHECK)
    return RunPlan.from_manifest(manifest)


def finish(
    folder: str | Path,
    *,
    paths: int = 0,
    seconds: float = 0.0,
    writing: float = 0.0,
    waiting: float = 0.0,
) -> Summary:
    """Complete the manifest if every shard is finished, and summarize (``mbtf-gen merge``).

    Parameters
    ----------
    paths, seconds, writing, waiting : of the run that ends, see :class:`Summary`

    Raises
    ------
    InputError : no data set, or a corrupt manifest or sidecar
    PartialError : too many non-finite samples, or the folder cannot be written
    """
    folder = Path(folder)
    path = folder / MANIFEST_NAME
    Dataset.open(folder)
    manifest = read_manifest(folder)
    check_document(_Plan, manifest, path, _CHECK)
    totals, complete = ShardStatistics(), True
    for content in manifest["splits"].values():
        for entry in content["shards"]:
            file = folder / entry["file"]
            record = finished_record(file, entry["rows"], manifest["config_hash"])
            if record is None:
                complete = False
            else:
                check_document(_Sidecar, record, sidecar_of(file), _CHECK)
                totals.add(record)
    if complete:
        refuse_nonfinite(totals, totals.paths, folder)
    summary = Summary(
        folder=str(folder),
        complete=complete,
        queries=totals.queries.total(),
        splits={split: totals.queries[split] for split in manifest["splits"]},
        paths=paths,
        seconds=round(seconds, 3),
        paths_per_second=round(paths / seconds, 1) if seconds > 0 else 0.0,
        writing_seconds=round(writing, 3),
        waiting_seconds=round(waiting, 3),
        shard_seconds=round(totals.seconds, 3),
        relative_error=totals.relative_error(),
        mean_value=totals.mean_value(),
        lost=totals.counts["lost_rays"],
        capped=totals.counts["capped_rays"],
        nonfinite=totals.counts["nonfinite_samples"],
        effects=[EFFECTS[e["name"]] for e in manifest["effects"]["effects"] if e["on"]],
        target=totals.target(),
    )
    if complete and not manifest["complete"]:
        complete_manifest(folder, totals)
    if complete:
        remove_leftovers(folder)
    return summary


def complete_manifest(folder: Path, totals: ShardStatistics) -> None:
    """Write into the manifest that every shard is finished, with a summary of all.

    Raises
    ------
    PartialError : the folder cannot be written
    """
    with brief_lock(folder / MANIFEST_NAME):
        manifest = read_manifest(folder)
        if not manifest["complete"]:
            manifest["complete"] = True
            manifest["software"] = software_versions()
            manifest["summary"] = {
                "queries": totals.queries.total(),
                "paths": totals.paths,
                "shard_seconds": round(totals.seconds, 3),
                "relative_error": totals.relative_error(),
                "mean_value": totals.mean_value(),
                "target": totals.target(),
                **{name: totals.counts[name] for name in COUNTS},
            }
            write_checksummed(folder / MANIFEST_NAME, manifest)


def summary_dict(summary: Summary) -> dict[str, Any]:
    """Summary as plain data for ``--json``."""
    return asdict(summary)

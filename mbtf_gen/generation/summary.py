"""The summary of a data set, from the sidecars of its shards, and the completion of its manifest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.documents import finished_record, read_manifest, software_versions
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.schema import MANIFEST_NAME
from mbtf_core.errors import PartialError
from mbtf_core.files.atomic import checksummed
from mbtf_core.locks import brief_lock
from mbtf_gen.effects.catalog import EFFECTS
from mbtf_gen.generation.manifest import stored_plan

# A run fails beyond this share of non-finite samples, but never for so few: with one expected, more than four
# occur by chance once in 300 runs.
NONFINITE_SHARE = 1e-6
NONFINITE_FEW = 4
_SHOWN = 3


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
    paths, seconds, paths_per_second : int, float, float
        Paths traced in this run, its duration, their ratio.
    writing_seconds : float
        Processor time of writing and digesting in this run, parallel to the rendering.
    waiting_seconds : float
        Time that rendering waited for the writer.
    shard_seconds : float
        Rendering time of all finished shards, over all runs.
    relative_error : float or None
        Pooled relative standard error of the training values, √(mean variance) / mean value; None where
        their noise is unknown.
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
    measured : bool
        Whether the values are measured, not rendered.
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
    relative_error: float | None
    mean_value: list[float]
    lost: int
    capped: int
    nonfinite: int
    effects: list[str]
    target: dict[str, float] | None
    measured: bool = False


class ShardStatistics:
    """Sums over shards.

    Attributes
    ----------
    queries : by split; paths, seconds : over all shards
    counts : of quarantined samples, by the sidecar's names
    located : the first few non-finite samples, as words
    """

    def __init__(self) -> None:
        self.queries: Counter[str] = Counter()
        self.paths = 0
        self.seconds = 0.0
        self.counts = dict.fromkeys(("nonfinite_samples", "lost_rays", "capped_rays"), 0)
        self.located: list[str] = []
        self._value = np.zeros(3)
        self._variance: NDArray[np.float64] | None = np.zeros(3)
        self._targeted = self._missed = 0
        self._worst = self._square = 0.0

    def add(self, record: Mapping[str, Any]) -> None:
        """Add a shard by its sidecar."""
        self.queries[record["split"]] += record["queries"]
        self.paths += record["paths"]
        self.seconds += record["seconds"]
        self.add_quarantined(record["file"], record["quarantined"])
        target = record["target"]
        if target is not None:
            self._targeted += target["queries"]
            self._missed += target["missed"]
            self._worst = max(self._worst, target["worst"])
            self._square += target["queries"] * target["square"]
        if record["split"] == "train":
            self._value += record["queries"] * np.asarray(record["statistics"]["mean_value"])
            variance = record["statistics"]["mean_variance"]
            if variance is None or self._variance is None:
                self._variance = None
            else:
                self._variance = self._variance + record["queries"] * np.asarray(variance)

    def add_quarantined(self, file: str, quarantined: Mapping[str, Any]) -> None:
        """Add a shard's quarantined samples alone."""
        for name in self.counts:
            self.counts[name] += quarantined[name]
        for bad in quarantined["nonfinite_at"][: _SHOWN - len(self.located)]:
            self.located.append(f"{file} query {bad['query']}, {bad['effect']}")

    @property
    def train(self) -> int:
        """Training queries."""
        return self.queries["train"]

    def mean_value(self) -> list[float]:
        """Mean training value per channel, 1/sr; 0 without any."""
        return [float(v) for v in self._value / max(self.train, 1)]

    def target(self) -> dict[str, float] | None:
        """Result of a run with a target error: RMS error reached, number and share of queries that missed the
        target, and the largest error among them; None without a target."""
        if not self._targeted:
            return None
        return {
            "reached": float(np.sqrt(self._square / self._targeted)),
            "missed": self._missed,
            "share": self._missed / self._targeted,
            "worst": self._worst,
        }

    def relative_error(self) -> float | None:
        """Pooled relative standard error of the training values, √(mean variance) / mean value; None of
        measured data, whose noise is unknown."""
        if self._variance is None:
            return None
        mean = float(self._value.mean()) / max(self.train, 1)
        variance = float(self._variance.mean()) / max(self.train, 1)
        return float(np.sqrt(variance)) / mean if mean > 0 else 0.0


def refuse_nonfinite(totals: ShardStatistics, paths: int, folder: object) -> None:
    """Fail if the shards have more non-finite samples than a data set of `paths` may have."""
    count = totals.counts["nonfinite_samples"]
    if count > max(NONFINITE_FEW, NONFINITE_SHARE * paths):
        raise PartialError(
            f"{count} of {paths} samples were NaN or infinite, more than 1 in 10⁶: "
            f"{'; '.join(totals.located)}",
            where=folder,
            hint="check the material's values, then run again with --overwrite",
        )


def finish(
    folder: str | Path | DataFolder,
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
        refuse_nonfinite(totals, totals.paths, folder)
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
        writing_seconds=round(writing, 3),
        waiting_seconds=round(waiting, 3),
        lost=totals.counts["lost_rays"],
        capped=totals.counts["capped_rays"],
        nonfinite=totals.counts["nonfinite_samples"],
        effects=[EFFECTS[e.name].description for e in effects if e.on],
        measured=measured,
        **sums,
    )

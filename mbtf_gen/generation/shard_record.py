"""Finished shards: the record that each writes beside its arrays, and the sums over these records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.documents import Quarantined, Sidecar, Statistics
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.schema import ShardEntry
from mbtf_core.data.shard_files import Arrays, write_shard
from mbtf_core.errors import PartialError
from mbtf_core.files.atomic import Stored
from mbtf_gen.render.estimates import Estimates

# A run fails beyond this share of non-finite samples, but never for so few: with one expected, more than four
# occur by chance once in 300 runs.
NONFINITE_SHARE = 1e-6
NONFINITE_FEW = 4
_SHOWN = 3


def store_shard(
    folder: DataFolder,
    entry: ShardEntry,
    arrays: Arrays,
    config_hash: str,
    plan: str,
    seed: int,
    *,
    spp: int | None = None,
    estimates: Estimates | None = None,
    seconds: float = 0.0,
) -> dict[str, Any]:
    """Write a shard, then its sidecar, which is returned; errors as of
    :meth:`~mbtf_core.data.folder.DataFolder.write_shard`.

    `config_hash` and `plan` are digests. Measured values have no ``value_b``, for their noise is unknown, no
    `spp` (the planned paths of a query), and no `estimates`.
    """
    halves = [arrays[name].reshape(-1, 3) for name in ("value_a", "value_b") if name in arrays]
    mean = sum(half.mean(axis=0, dtype=np.float64) for half in halves) / len(halves)
    variance = None
    if len(halves) == 2:
        difference = (halves[0] - halves[1]).astype(np.float64)
        variance = (0.25 * np.square(difference).mean(axis=0)).tolist()
    quarantined = Quarantined()
    if estimates is not None:
        quarantined = Quarantined(
            nonfinite_samples=estimates.nonfinite,
            lost_rays=estimates.lost,
            capped_rays=estimates.capped,
            nonfinite_at=list(estimates.bad_samples),
        )

    def record(stored: Stored) -> dict[str, Any]:
        return Sidecar(
            config_hash=config_hash,
            plan=plan,
            **asdict(entry),
            **asdict(stored),
            seed={"root": seed, "split": entry.split, "shard": entry.index},
            spp=spp,
            queries=len(halves[0]),
            paths=0 if estimates is None else estimates.paths,
            seconds=round(seconds, 4),
            quarantined=quarantined,
            target=None if estimates is None else estimates.target,
            statistics=Statistics(mean_value=mean.tolist(), mean_variance=variance),
        ).as_dict()

    return folder.write_shard(entry.file, lambda path: write_shard(path, arrays), record)


class ShardStatistics:
    """Sums over the records of shards.

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
        for name in self.counts:
            self.counts[name] += record["quarantined"][name]
        for bad in record["quarantined"]["nonfinite_at"][: _SHOWN - len(self.located)]:
            self.located.append(f"{record['file']} query {bad['query']}, {bad['effect']}")
        if (target := record["target"]) is not None:
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

    def refuse_nonfinite(self, paths: int, folder: object) -> None:
        """Fail if there are more non-finite samples than a data set of `paths` may have."""
        count = self.counts["nonfinite_samples"]
        if count > max(NONFINITE_FEW, NONFINITE_SHARE * paths):
            raise PartialError(
                f"{count} of {paths} samples were NaN or infinite, more than 1 in 10⁶: "
                f"{'; '.join(self.located)}",
                where=folder,
                hint="check the material's values, then run again with --overwrite",
            )

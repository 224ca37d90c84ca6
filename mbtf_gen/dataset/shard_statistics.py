"""Running sums over the sidecars of shards: counts, mean value, error, non-finite samples.

They keep a few numbers for any number of shards.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.errors import PartialError

# A run fails beyond this share of non-finite samples, but never for so few: with one expected, more than four
# occur by chance once in 300 runs.
NONFINITE_SHARE = 1e-6
NONFINITE_FEW = 4
_SHOWN = 3

COUNTS = ("nonfinite_samples", "lost_rays", "capped_rays")


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
        self.counts: Counter[str] = Counter()
        self.located: list[str] = []
        self._value = np.zeros(3)
        self._variance = np.zeros(3)
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
            self._variance += record["queries"] * np.asarray(record["statistics"]["mean_variance"])

    def add_quarantined(self, file: str, quarantined: Mapping[str, Any]) -> None:
        """Add a shard's quarantined samples alone."""
        for name in COUNTS:
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

    def relative_error(self) -> float:
        """Pooled relative standard error of the training values, √(mean variance) / mean value."""
        mean = float(self._value.mean()) / max(self.train, 1)
        variance = float(self._variance.mean()) / max(self.train, 1)
        return float(np.sqrt(variance)) / mean if mean > 0 else 0.0


def refuse_nonfinite(totals: ShardStatistics, paths: int, folder: Path) -> None:
    """Fail if the shards have more non-finite samples than a data set may have.

    Parameters
    ----------
    paths : of the whole data set

    Raises
    ------
    PartialError : more than ``NONFINITE_FEW`` and more than ``NONFINITE_SHARE`` of the paths; says where
    """
    count = totals.counts["nonfinite_samples"]
    if count <= max(NONFINITE_FEW, NONFINITE_SHARE * paths):
        return
    raise PartialError(
        f"{count} of {paths} samples were NaN or infinite, more than 1 in 10⁶: {'; '.join(totals.located)}",
        where=folder,
        hint="check the material's values, then run again with --overwrite",
    )

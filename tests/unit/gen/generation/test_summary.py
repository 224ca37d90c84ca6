"""The last lines of a run: the error it reached and the marginal cost; the limit on non-finite samples."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mbtf_core.errors import PartialError
from mbtf_gen.cli.generate import describe
from mbtf_gen.generation.manifest import Summary
from mbtf_gen.generation.shard_record import ShardStatistics

COUNTS: dict[str, Any] = {"queries": 1000, "splits": {"train": 900, "test": 100}, "paths": 8000}
COUNTS |= dict.fromkeys(("lost", "capped", "nonfinite", "writing_seconds", "waiting_seconds"), 0)
TIMES: dict[str, Any] = {"seconds": 4.0, "shard_seconds": 20.0, "paths_per_second": 2000.0}
VALUES: dict[str, Any] = {"mean_value": [0.1] * 3, "relative_error": 0.5, "effects": [], "target": None}
SUMMARY = Summary(folder="shards", complete=True, **COUNTS, **TIMES, **VALUES)


def test_halving_the_error_takes_three_times_the_seconds_so_far() -> None:
    # Of all runs: this one may have resumed most of them. Unfinished and exact runs have no marginal cost.
    assert "50.0% of the mean; halving it would take about 1:00 more" in describe(SUMMARY)
    for summary in (replace(SUMMARY, complete=False), replace(SUMMARY, relative_error=0.0)):
        assert "halving" not in describe(summary)


@pytest.mark.parametrize(
    ("count", "paths", "refused"), [(4, 1, False), (5, 4_999_999, True), (5, 5_000_000, False)]
)
def test_one_sample_in_a_million_may_be_nonfinite(count: int, paths: int, refused: bool) -> None:
    statistics = ShardStatistics()
    quarantined = {"nonfinite_samples": count, "lost_rays": 0, "capped_rays": 0, "nonfinite_at": []}
    record = {"file": "test-00000.npz", "split": "test", "queries": 1, "paths": paths, "seconds": 0.0}
    statistics.add({**record, "quarantined": quarantined, "target": None})
    with pytest.raises(PartialError) if refused else contextlib.nullcontext():
        statistics.refuse_nonfinite(paths, Path("out"))

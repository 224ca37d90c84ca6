"""Sums over sidecars: the limit on non-finite samples."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from mbtf_core.errors import PartialError
from mbtf_gen.dataset.summary import ShardStatistics, refuse_nonfinite


@pytest.mark.parametrize(
    ("count", "paths", "refused"), [(4, 1, False), (5, 4_999_999, True), (5, 5_000_000, False)]
)
def test_one_sample_in_a_million_may_be_nonfinite(count: int, paths: int, refused: bool) -> None:
    statistics = ShardStatistics()
    quarantined = {"nonfinite_samples": count, "lost_rays": 0, "capped_rays": 0, "nonfinite_at": []}
    statistics.add_quarantined("train-00000.npz", quarantined)
    with pytest.raises(PartialError) if refused else contextlib.nullcontext():
        refuse_nonfinite(statistics, paths, Path("out"))

"""What a run says at its end: what it bought, and what more would cost."""

from __future__ import annotations

from dataclasses import replace

from mbtf_gen.cli.generate import describe
from mbtf_gen.dataset.summary import Summary

SUMMARY = Summary(
    folder="shards",
    complete=True,
    queries=1000,
    splits={"train": 900, "test": 100},
    paths=8000,
    seconds=4.0,
    paths_per_second=2000.0,
    writing_seconds=0.1,
    waiting_seconds=0.0,
    shard_seconds=20.0,
    relative_error=0.5,
    mean_value=[0.1, 0.1, 0.1],
    lost=0,
    capped=0,
    nonfinite=0,
    effects=["parallax and masking"],
    target=None,
)


def test_half_the_noise_takes_three_times_the_seconds_of_all_shards_more() -> None:
    # Of all runs: this one may have resumed most of them.
    assert "50.0% of the mean; halving it would take about 1:00 more" in describe(SUMMARY)


def test_nothing_is_promised_where_it_makes_no_sense() -> None:
    for summary in (replace(SUMMARY, complete=False), replace(SUMMARY, relative_error=0.0)):
        assert "halving" not in describe(summary)

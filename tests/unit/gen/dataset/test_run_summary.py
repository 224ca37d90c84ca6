"""The last lines of a run: the error it reached and the marginal cost."""

from __future__ import annotations

from dataclasses import replace

from mbtf_gen.cli.generate import describe
from mbtf_gen.dataset.summary import Summary

COUNTS = {"queries": 1000, "splits": {"train": 900, "test": 100}, "paths": 8000, "lost": 0, "capped": 0}
TIMES = {"seconds": 4.0, "writing_seconds": 0.1, "waiting_seconds": 0.0, "shard_seconds": 20.0}
OTHER = {
    "paths_per_second": 2000.0,
    "mean_value": [0.1, 0.1, 0.1],
    "nonfinite": 0,
    "effects": [],
    "target": None,
}
SUMMARY = Summary(folder="shards", complete=True, relative_error=0.5, **COUNTS, **TIMES, **OTHER)  # type: ignore[arg-type]


def test_halving_the_error_takes_three_times_the_seconds_so_far() -> None:
    # Of all runs: this one may have resumed most of them.
    assert "50.0% of the mean; halving it would take about 1:00 more" in describe(SUMMARY)


def test_unfinished_and_exact_runs_have_no_marginal_cost() -> None:
    for summary in (replace(SUMMARY, complete=False), replace(SUMMARY, relative_error=0.0)):
        assert "halving" not in describe(summary)

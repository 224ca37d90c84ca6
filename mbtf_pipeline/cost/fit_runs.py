"""Which runs a study plans for its time."""

from __future__ import annotations

from itertools import product
from typing import Any

from mbtf_core.config.settings import nested
from mbtf_fit.config import DEFAULT_MODEL
from mbtf_fit.presets import best_options
from mbtf_pipeline.cost.repeats import FEWEST_SEEDS
from mbtf_pipeline.cost.runs import DataRequest, Run
from mbtf_pipeline.time_split import round_down

# Shares of a study's time that the generator and the runs get, of two seeds each. The rest is left for
# start-up, the test set and evaluation.
GENERATOR, RUNS = 0.1, 0.7
# Total times of complete runs, seconds: this one, twice, four times, ...; the share of each that generates.
SHORTEST = 8.0
SHARE, OTHER_SHARES = 0.35, (0.6, 0.15)
_FEWEST_QUERIES = 20_000


def planned_runs(seconds: float, spp: int, path_seconds: float) -> list[Run]:
    """All runs of a study, in the order of measuring, each with the study's own seed.

    Total times double; the time that is then left goes to other shares of generating, shortest first.

    Parameters
    ----------
    seconds : float
        Time of the study.
    spp : int
        Paths of a query.
    path_seconds : float
        Seconds of generating a query over its number of paths.

    Returns
    -------
    list of Run
    """
    seconds *= RUNS / FEWEST_SEEDS
    totals = [SHORTEST]
    while sum(totals) + 2 * totals[-1] <= seconds:
        totals.append(2 * totals[-1])
    left = seconds - sum(totals)
    planned = [(total, SHARE) for total in totals]
    for total, share in product(totals, OTHER_SHARES):
        if total <= left:
            planned.append((total, share))
            left -= total
    return [
        Run(
            "whole",
            f"{100 * share:.0f} % of the time for generating",
            f"planned for {total:g} s",
            DataRequest(round_down(max(_FEWEST_QUERIES, share * total / (spp * path_seconds))), spp),
            _preset((1 - share) * total),
        )
        for total, share in planned
    ]


def _preset(seconds: float) -> dict[str, Any]:
    """A fit with the options of the quality presets."""
    return nested({"model": DEFAULT_MODEL, **best_options(seconds), "training.time": f"{seconds:.3g}s"})

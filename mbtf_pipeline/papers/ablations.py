"""Ablations: the change of the error when one option is changed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from mbtf_core.stats import Estimate
from mbtf_pipeline.papers.cells import Cell, Column, Table, rows_of
from mbtf_pipeline.papers.runs import FinishedRun, each_fit

# The runs of one variant, by material.
Runs = dict[str, FinishedRun]
_TEXT = (
    "The first row is the baseline; every other row changes one option. Differences are of MSE on the same "
    "test queries. They are paired for fits on the same data. For fits on other data, the two errors are "
    "taken as independent, so the error bars are wider."
)


def ablations(runs: Sequence[FinishedRun]) -> list[Table]:
    """Every fit of every variant against the first fit of the first variant, per material."""
    columns = [
        Column("variant", "variant", _label),
        Column("network weights", "network_weights", lambda own, fit: _any(own).fit(fit)["network_weights"]),
        Column("texture values", "texels", lambda own, fit: _any(own).fit(fit)["texels"]),
        Column("queries per texel", "queries_per_texel", lambda own, fit: _density(_any(own)), digits=".0f"),
    ]
    for material in dict.fromkeys(run.material for run in runs):
        columns += _of_material(next(run for run in runs if run.material == material))
    # All fits of the first variant, then of the next.
    items = [
        ({run.material: run for run in runs if run.variant == variant and fit in run.fits}, fit)
        for variant, fit in dict.fromkeys((run.variant, fit) for run, fit in each_fit(runs))
    ]
    return [Table("ablations", "Ablations", _TEXT, columns, rows_of(columns, items))]


def _any(own: Runs) -> FinishedRun:
    return next(iter(own.values()))


def _label(own: Runs, fit: str) -> str:
    run = _any(own)
    return fit if len(run.fits) > 1 or not run.variant else run.variant


def _density(run: FinishedRun) -> float:
    return float(run.manifest["splits"]["train"]["queries"] / run.texels)


def _of_material(first: FinishedRun) -> list[Column]:
    """Columns of the material whose baseline is the first fit of this run."""

    def column(title: str, key: str, get: Callable[[FinishedRun, str], Cell], *look: Any) -> Column:
        def cell(own: Runs, fit: str) -> Cell:
            return get(own[first.material], fit) if first.material in own else None

        return Column(f"{first.title}: {title}", f"{first.material}_{key}", cell, *look)

    def difference(run: FinishedRun, fit: str) -> Cell:
        if run is first:
            return run.minus_first(fit)
        mse, base = run.mse(fit), first.mse(first.fits[0])
        return Estimate(mse.value - base.value, math.hypot(mse.error, base.error), min(mse.n, base.n))

    return [
        column("unexplained variance [%]", "unexplained", FinishedRun.unexplained, 100.0),
        column("MSE − MSE of the first [10⁻³/sr²]", "minus_first", difference, 1e3),
        column("training [s]", "seconds", FinishedRun.seconds, 1.0, ".0f"),
    ]

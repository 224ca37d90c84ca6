"""Ablations: the change of the error when one option is changed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from mbtf_core.stats import Estimate
from mbtf_pipeline.paper_tables.cells import Cell, Column, Table, rows_of
from mbtf_pipeline.paper_tables.runs import FinishedRun, each_fit

Runs = dict[str, FinishedRun]


def ablations(runs: Sequence[FinishedRun]) -> list[Table]:
    """Every fit of every variant against the first fit of the first variant, per material."""
    first = {run.material: run for run in reversed(runs)}
    columns = [
        Column("variant", "variant", _label),
        Column("network weights", "network_weights", lambda own, fit: _any(own).fit(fit)["network_weights"]),
        Column("texture values", "texels", lambda own, fit: _any(own).fit(fit)["texels"]),
        Column("queries per texel", "queries_per_texel", lambda own, fit: _density(_any(own)), digits=".0f"),
    ]
    for material in dict.fromkeys(run.material for run in runs):
        columns += _of_material(material, first[material])
    # Rows hold the runs of one variant by material: all fits of the first variant, then of the next.
    settings = dict.fromkeys((run.variant, fit) for run, fit in each_fit(runs))
    items = [
        ({run.material: run for run in runs if run.variant == variant and fit in run.fits}, fit)
        for variant, fit in settings
    ]
    text = (
        "The first row is the baseline; every other row changes one option. Differences are of MSE on the "
        "same test queries. They are paired for fits on the same data. For fits on other data, the two "
        "errors are taken as independent, so the error bars are wider."
    )
    return [Table("ablations", "Ablations", text, columns, rows_of(columns, items))]


def _any(own: Runs) -> FinishedRun:
    return next(iter(own.values()))


def _label(own: Runs, fit: str) -> str:
    run = _any(own)
    return fit if len(run.fits) > 1 or not run.variant else run.variant


def _density(run: FinishedRun) -> float:
    return float(run.manifest["splits"]["train"]["queries"] / run.texels)


def _of_material(material: str, first: FinishedRun) -> list[Column]:
    def of(get: Callable[[FinishedRun, str], Cell]) -> Callable[[Runs, str], Cell]:
        return lambda own, fit: get(own[material], fit) if material in own else None

    def difference(run: FinishedRun, fit: str) -> Cell:
        if run is first:
            return run.minus_first(fit)
        mse, base = run.mse(fit), first.mse(first.fits[0])
        return Estimate(mse.value - base.value, math.hypot(mse.error, base.error), min(mse.n, base.n))

    name = first.title
    return [
        Column(
            f"{name}: unexplained variance [%]", f"{material}_unexplained", of(FinishedRun.unexplained), 100.0
        ),
        Column(f"{name}: MSE − MSE of the first [10⁻³/sr²]", f"{material}_minus_first", of(difference), 1e3),
        Column(f"{name}: training [s]", f"{material}_seconds", of(FinishedRun.seconds), digits=".0f"),
    ]

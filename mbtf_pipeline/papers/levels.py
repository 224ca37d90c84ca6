"""Errors by level of detail."""

from __future__ import annotations

from collections.abc import Sequence

from mbtf_core.stats import Estimate
from mbtf_pipeline.formatting import estimate
from mbtf_pipeline.papers.cells import MATERIAL, METHOD, Cell, Column, Table, mean_of, ratio_of, rows_of
from mbtf_pipeline.papers.published import level_ratios
from mbtf_pipeline.papers.runs import FinishedRun, each_fit
from mbtf_pipeline.report.plots import points

_TEXT = (
    "MSE in 10⁻³/sr² of test queries by the level nearest to their footprint. Level 0 is the whole tile, the "
    "last level the finest. The true value of a query is the integral over its own footprint. The plot shows "
    "unexplained variance, averaged over materials so that bright ones do not dominate."
)
_RELATIVE_TEXT = (
    "MSE divided by the MSE at the finest level (zoom 0). Published ratios belong to another material with "
    "the same name. The errors at two levels are taken as independent."
)


def levels(runs: Sequence[FinishedRun]) -> list[Table]:
    """MSE at every level, and relative to the finest, beside published ratios."""
    names = sorted({int(level) for run in runs for level in run.test(run.fits[0])["levels"]})
    return [_errors(runs, names), _relative(runs, names[::-1])]


def _at(run: FinishedRun, fit: str, level: int, key: str) -> Estimate | None:
    group = run.test(fit)["levels"].get(str(level))
    return None if group is None or group[key]["value"] is None else estimate(group[key])


def _errors(runs: Sequence[FinishedRun], names: list[int]) -> Table:
    def at(level: int) -> Column:
        title = f"level {level}"
        return Column(title, f"mse_level_{level}", lambda r, f: _at(r, f, level, "mse"), 1e3)

    columns = [MATERIAL, METHOD, *(at(n) for n in names)]
    label, x, y = "unexplained variance by level of detail", "level of detail", "unexplained variance"
    fits = dict.fromkeys(fit for _, fit in each_fit(runs))
    svg = points(
        [str(n) for n in names], {fit: [_mean(runs, fit, n) for n in names] for fit in fits}, x, y, label
    )
    plots = [{"title": f"Mean over {len(runs)} materials", "svg": svg}]
    title = f"Errors at {len(names)} levels of detail"
    return Table("levels", title, _TEXT, columns, rows_of(columns, each_fit(runs)), plots)


def _mean(runs: Sequence[FinishedRun], fit: str, level: int) -> tuple[float, float] | None:
    found = [_at(run, fit, level, "unexplained") for run in runs if fit in run.fits]
    known = [e for e in found if e is not None]
    mean = mean_of(known) if known else None
    return None if mean is None else (mean.value, mean.error)


def _relative(runs: Sequence[FinishedRun], finest_first: list[int]) -> Table:
    columns = [
        MATERIAL,
        METHOD,
        Column("source", "source"),
        *(Column(f"zoom {k}", f"ratio_zoom_{k}") for k in range(len(finest_first))),
    ]
    rows: list[list[Cell]] = []
    for run, fit in each_fit(runs):
        first, *others = (_at(run, fit, n, "mse") for n in finest_first)
        if first is None:
            continue
        cells = [None if e is None else ratio_of(e, first) for e in others]
        rows.append([run.title, fit, "measured here", 1.0, *cells])
        known = level_ratios(run.material, fit)
        if known is not None:
            ratios = [*known[0], *[None] * len(finest_first)][: len(finest_first)]
            rows.append([run.title, fit, f"published, {known[1]}", *ratios])
    return Table("level_ratios", "Errors relative to the finest level", _RELATIVE_TEXT, columns, rows)

"""Errors over levels of detail."""

from __future__ import annotations

from collections.abc import Sequence

from mbtf_core.stats import Estimate
from mbtf_pipeline.formatting import estimate
from mbtf_pipeline.paper_tables.cells import Cell, Column, Table, mean_of, ratio_of
from mbtf_pipeline.paper_tables.published import level_ratios
from mbtf_pipeline.paper_tables.runs import Run, name_of
from mbtf_pipeline.report.plots import points


def levels(runs: Sequence[Run]) -> list[Table]:
    """MSE at every level, and relative to the finest, beside published ratios."""
    names = sorted({int(level) for run in runs for level in run.test(run.fits[0])["levels"]})
    return [_errors(runs, names), _relative(runs, names)]


def _at(run: Run, fit: str, level: int, key: str) -> Estimate | None:
    group = run.test(fit)["levels"].get(str(level))
    if group is None or group[key]["value"] is None:
        return None
    return estimate(group[key])


def _errors(runs: Sequence[Run], names: list[int]) -> Table:
    columns = [
        Column("material", "material"),
        Column("method", "method"),
        *(Column(f"level {n}", f"mse_level_{n}", 1e3, second="se") for n in names),
    ]
    rows: list[list[Cell]] = [
        [name_of(run.material), fit, *(_at(run, fit, n, "mse") for n in names)]
        for run in runs
        for fit in run.fits
    ]
    text = (
        "MSE in 10⁻³/sr² of test queries by the level nearest to their footprint: 0 is the whole tile, "
        "the last the finest. Every query is answered at its own footprint, and its truth is the integral "
        "over that footprint, not a picture pyramid. The plot shows unexplained variance, the mean over "
        "the materials, so that bright ones do not count more."
    )
    fits = list(dict.fromkeys(fit for run in runs for fit in run.fits))
    series = {fit: [_mean(runs, fit, n) for n in names] for fit in fits}
    svg = points(
        [str(n) for n in names],
        series,
        "level of detail",
        "unexplained variance",
        "unexplained variance over levels of detail",
    )
    plots = [{"title": f"Mean over {len(runs)} materials", "svg": svg}]
    return Table("levels", f"Errors over {len(names)} levels of detail", text, columns, rows, plots)


def _mean(runs: Sequence[Run], fit: str, level: int) -> tuple[float, float] | None:
    found = [_at(run, fit, level, "unexplained") for run in runs if fit in run.fits]
    known = [e for e in found if e is not None]
    if not known:
        return None
    mean = mean_of(known)
    return mean.value, mean.error


def _relative(runs: Sequence[Run], names: list[int]) -> Table:
    finer = sorted(names, reverse=True)
    columns = [
        Column("material", "material"),
        Column("method", "method"),
        Column("whose", "whose"),
        *(Column(f"zoom {k}", f"ratio_zoom_{k}", second="se") for k in range(len(finer))),
    ]
    rows: list[list[Cell]] = []
    for run in runs:
        for fit in run.fits:
            own = [_at(run, fit, n, "mse") for n in finer]
            first = own[0]
            if first is None:
                continue
            cells: list[Cell] = [None if e is None else ratio_of(e, first) for e in own]
            cells[0] = 1.0
            rows.append([name_of(run.material), fit, "measured here", *cells])
            known = level_ratios(run.material, fit)
            if known is not None:
                ratios: list[Cell] = [p.ratio for p in known[: len(finer)]]
                ratios += [None] * (len(finer) - len(ratios))
                rows.append([name_of(run.material), fit, f"published, {known[0].source}", *ratios])
    text = (
        "MSE over that at the finest level, which is zoom 0; published ratios are of a paper’s own "
        "material of this name. Errors of both levels are taken as independent."
    )
    return Table("level_ratios", "Errors over levels, relative to the finest", text, columns, rows)

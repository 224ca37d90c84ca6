"""Ablations: what becomes of the error when one thing is changed."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mbtf_core.stats import Estimate
from mbtf_pipeline.formatting import estimate
from mbtf_pipeline.paper_tables.cells import Cell, Column, Table
from mbtf_pipeline.paper_tables.runs import Run, name_of


def ablations(runs: Sequence[Run]) -> list[Table]:
    """Every fit of every variant against the first fit of the first variant, per material."""
    materials = list(dict.fromkeys(run.material for run in runs))
    columns = [
        Column("variant", "variant"),
        Column("network weights", "network_weights"),
        Column("texture values", "texels"),
        Column("queries per texel", "queries_per_texel", digits=".0f"),
    ]
    for material in materials:
        name = name_of(material)
        columns += [
            Column(f"{name}: unexplained variance [%]", f"{material}_unexplained", 100.0, second="se"),
            Column(f"{name}: MSE less the first’s [10⁻³/sr²]", f"{material}_less_first", 1e3, second="se"),
            Column(f"{name}: training [s]", f"{material}_seconds", digits=".0f"),
        ]
    rows = [_row(runs, variant, fit, materials) for variant, fit in _settings(runs)]
    text = (
        "The first row is what the others change one thing of. Differences are of MSE on the same test "
        "queries; of fits on the same data query by query, of fits on other data as of two separate "
        "errors, so with wider bars. A difference below two error bars tells nothing apart."
    )
    return [Table("ablations", "Ablations", text, columns, rows)]


def _settings(runs: Sequence[Run]) -> list[tuple[str, str]]:
    """(variant, fit) in order: all fits of the first variant, then of the next."""
    return list(dict.fromkeys((run.variant, fit) for run in runs for fit in run.fits))


def _row(runs: Sequence[Run], variant: str, fit: str, materials: list[str]) -> list[Cell]:
    own = {run.material: run for run in runs if run.variant == variant and fit in run.fits}
    first = {run.material: run for run in reversed(runs)}
    run = next(iter(own.values()))
    queries = run.manifest["splits"]["train"]["queries"]
    rows, columns = run.finest_shape
    label = fit if len(run.fits) > 1 or not variant else variant
    row: list[Cell] = [
        label,
        int(run.size(fit)["network_weights"]),
        int(run.size(fit)["texels"]),
        queries / (rows * columns),
    ]
    for material in materials:
        found = own.get(material)
        if found is None:
            row += [None, None, None]
            continue
        row += [
            estimate(found.test(fit)["unexplained"]),
            _less(found, fit, first[material]),
            float(found.size(fit)["training_seconds"]),
        ]
    return row


def _less(run: Run, fit: str, first: Run) -> Estimate | None:
    if run is first:
        return run.less_first(fit)
    mine, base = run.mse(fit), first.mse(first.fits[0])
    return Estimate(mine.value - base.value, math.hypot(mine.error, base.error), min(mine.n, base.n))

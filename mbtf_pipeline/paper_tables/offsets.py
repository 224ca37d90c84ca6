"""Learned offsets over the view's elevation, against those traced from the heights."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mbtf_pipeline.compare.offsets import read_offset, towards_view
from mbtf_pipeline.paper_tables.cells import Cell, Column, Figure, Table
from mbtf_pipeline.paper_tables.figures import signed
from mbtf_pipeline.paper_tables.runs import Run, name_of
from mbtf_pipeline.recipe import View
from mbtf_pipeline.report.error_maps import common_scale
from mbtf_pipeline.run_folder import COMPARE


def offsets(runs: Sequence[Run]) -> list[Table]:
    """Agreement of learned and traced offsets at every view."""
    columns = [
        Column("material", "material"),
        Column("method", "method"),
        Column("view: elevation", "elevation", digits=".0f"),
        Column("azimuth", "azimuth", digits=".0f"),
        Column("spread, traced [tile widths]", "spread_traced", digits=".2g"),
        Column("spread, learned [tile widths]", "spread_learned", digits=".2g"),
        Column("correlation", "correlation", digits=".2f"),
        Column("slope of learned over traced", "slope", digits=".2f"),
    ]
    rows: list[list[Cell]] = []
    for run in runs:
        for fit in run.fits:
            for record in run.comparison["offsets"]:
                if fit not in record["fits"]:
                    continue
                made, view = record["fits"][fit], record["view"]
                rows.append(
                    [
                        name_of(run.material),
                        fit,
                        float(view["elevation"]),
                        float(view["azimuth"]),
                        record["spread"],
                        made["spread"],
                        made["correlation"],
                        made["slope"],
                    ]
                )
    text = (
        "How far the surface that a view sees lies from the point of the reference plane that its ray "
        "passes, towards the viewer. Spread is the standard deviation over the tile; a slope of 1 is the "
        "same size. Nothing forces a fit to find what is traced: it sees colors alone, and its offset "
        "also stands for whatever else helps. Each row of pictures has one scale, blue away from the "
        "viewer, orange towards; every picture less its median."
    )
    return [Table("offsets", "Learned offsets over view angle", text, columns, rows, figures=_figures(runs))]


def _figures(runs: Sequence[Run]) -> list[tuple[str, list[Figure]]]:
    out: list[tuple[str, list[Figure]]] = []
    for run in runs:
        records = run.comparison["offsets"]
        if not records:
            continue
        for fit in (None, *records[0]["fits"]):
            fields: list[NDArray[np.float32]] = []
            for record in records:
                file = record["traced"] if fit is None else record["fits"][fit]["file"]
                moved = towards_view(read_offset(run.folder / COMPARE / file), View(**record["view"]))
                fields.append((moved - np.median(moved)).astype(np.float32))
            scale = common_scale(fields)
            row = [
                Figure(signed(f, scale), f"elevation {record['view']['elevation']:g}°")
                for f, record in zip(fields, records, strict=True)
            ]
            who = "traced" if fit is None else fit
            out.append((f"{name_of(run.material)}, {who}: ± {scale:.2g} tile widths", row))
    return out

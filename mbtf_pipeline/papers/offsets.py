"""Learned offsets by elevation of the view, compared with offsets traced through the heights."""

from __future__ import annotations

from collections.abc import Sequence

from mbtf_pipeline.papers.cells import MATERIAL, METHOD, Column, Table, Thumbnail, rows_of, signed_map
from mbtf_pipeline.papers.runs import FinishedRun, each_fit
from mbtf_pipeline.report.offsets import displacements
from mbtf_pipeline.run_folder import COMPARE


def _view(title: str, key: str) -> Column:
    return Column(title, key, lambda run, fit, record: float(record["view"][key]), digits=".0f")


def _learned(title: str, key: str, name: str, digits: str) -> Column:
    return Column(title, name, lambda run, fit, record: record["fits"][fit][key], digits=digits)


_COLUMNS = (
    MATERIAL,
    METHOD,
    _view("view: elevation", "elevation"),
    _view("azimuth", "azimuth"),
    Column("spread, traced [tile widths]", "spread_traced", lambda *item: item[-1]["spread"], digits=".2g"),
    _learned("spread, learned [tile widths]", "spread", "spread_learned", ".2g"),
    _learned("correlation", "correlation", "correlation", ".2f"),
    _learned("slope of learned on traced", "slope", "slope", ".2f"),
)
_TEXT = (
    "Displacement towards the viewer between the point where a view ray crosses the reference plane and "
    "the visible surface. Spread is the standard deviation over the tile. A slope of 1 means equal "
    "magnitude. Fits learn their offsets from colors only, so the offsets need not agree with the traced "
    "ones. Images of a row share one scale, blue away from the viewer and orange towards; the median of "
    "each image is subtracted."
)


def offsets(runs: Sequence[FinishedRun]) -> list[Table]:
    """Agreement of learned and traced offsets for every view."""
    items = [
        (run, fit, record)
        for run, fit in each_fit(runs)
        for record in run.comparison["offsets"]
        if fit in record["fits"]
    ]
    rows = rows_of(_COLUMNS, items)
    return [Table("offsets", "Learned offsets by view angle", _TEXT, _COLUMNS, rows, images=_images(runs))]


def _images(runs: Sequence[FinishedRun]) -> list[tuple[str, list[Thumbnail]]]:
    out = []
    for run in runs:
        records = run.comparison["offsets"]
        for fit in (None, *records[0]["fits"]) if records else ():
            maps, _, scale = displacements(run.folder / COMPARE, records, fit)
            row = [
                signed_map(m, scale, f"elevation {record['view']['elevation']:g}°")
                for m, record in zip(maps, records, strict=True)
            ]
            out.append((f"{run.title}, {fit or 'traced'}: ± {scale:.2g} tile widths", row))
    return out

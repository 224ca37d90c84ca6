"""The report's offset pictures: traced and learned displacements, each row on its own labeled scale."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mbtf_pipeline.compare.offsets import read_offset, towards_view
from mbtf_pipeline.formatting import direction
from mbtf_pipeline.recipe import View
from mbtf_pipeline.report.embed import Field, Gallery
from mbtf_pipeline.report.error_maps import common_scale, gradient, ticks
from mbtf_pipeline.report.pictures import Bar


def show_offsets(folder: Path, records: list[dict[str, Any]], gallery: Gallery) -> list[dict[str, Any]]:
    """Rows of offset pictures: traced, then each fit that learns one; each row with its own scale."""
    if not records:
        return []
    rows: list[tuple[str | None, str]] = [(None, "Traced from the heights")]
    rows += [(name, f"Learned by {name}") for name in records[0]["fits"]]
    return [_row(folder, records, index, what, title, gallery) for index, (what, title) in enumerate(rows)]


def _row(
    folder: Path, records: list[dict[str, Any]], index: int, what: str | None, title: str, gallery: Gallery
) -> dict[str, Any]:
    fields: list[Field] = []
    for record in records:
        file = record["traced"] if what is None else record["fits"][what]["file"]
        fields.append(towards_view(read_offset(folder / file), View(**record["view"])))
    medians = [float(np.median(f)) for f in fields]
    fields = [f - m for f, m in zip(fields, medians, strict=True)]
    scale = common_scale(fields)
    cells: list[dict[str, Any]] = []
    for record, shown, median in zip(records, fields, medians, strict=True):
        name = f"offset-{index}-{len(cells)}"

        def read(shown: Field = shown) -> Field:
            return shown / scale

        gallery.charts[name] = ("signed", read)
        lines = [f"view {direction(record['view'])}", f"median {median:.2g} tile widths".replace("-", "−")]
        if what is not None and record["fits"][what]["correlation"] is not None:
            lines.append(f"correlation with the traced one {record['fits'][what]['correlation']:.2f}")
        alt = f"{title}, view {direction(record['view'])}"
        cells.append({"image": name, "label": title, "lines": lines, "alt": alt})
    note = "displacement towards the viewer’s azimuth, less each picture’s median"
    bar = Bar("offset", "Displacement", gradient("signed"), ticks(-scale, scale), "tile widths", note)
    return {"cells": cells, "bar": bar}

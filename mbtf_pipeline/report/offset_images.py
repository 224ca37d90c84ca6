"""Offset images of the report: traced and learned displacements, each row with its own color scale."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mbtf_pipeline.compare.offsets import read_offset, towards_view
from mbtf_pipeline.recipe import SceneView
from mbtf_pipeline.report.embed import Gallery, Pixels
from mbtf_pipeline.report.error_maps import color_bar, common_scale
from mbtf_pipeline.report.image_sheet import exr_link
from mbtf_pipeline.tables import direction, signed


def displacements(
    folder: Path, records: list[dict[str, Any]], fit: str | None
) -> tuple[list[Pixels], list[float], float]:
    """Displacements towards the viewer, traced (`fit` is None) or learned, minus their median.

    Returns
    -------
    (one map per record, their medians in tile widths, end of their common scale)
    """
    files = [r["traced"] if fit is None else r["fits"][fit]["file"] for r in records]
    maps: list[Pixels] = [
        towards_view(read_offset(folder / file), SceneView(**record["view"]))
        for file, record in zip(files, records, strict=True)
    ]
    medians = [float(np.median(m)) for m in maps]
    centered = [m - median for m, median in zip(maps, medians, strict=True)]
    return centered, medians, common_scale(centered)


def offset_section(folder: Path, records: list[dict[str, Any]], gallery: Gallery) -> list[dict[str, Any]]:
    """Rows of offset images: traced, then learned by each fit."""
    return [_row(folder, records, fit, gallery) for fit in ((None, *records[0]["fits"]) if records else ())]


def _row(folder: Path, records: list[dict[str, Any]], fit: str | None, gallery: Gallery) -> dict[str, Any]:
    title = "Traced through the heights" if fit is None else f"Learned by {fit}"
    maps, medians, scale = displacements(folder, records, fit)
    cells = []
    for number, (record, values, median) in enumerate(zip(records, maps, medians, strict=True)):
        name = f"offset-{fit or 'traced'}-{number}"
        gallery.maps[name] = "signed", values / scale
        view = f"view {direction(record['view'])}"
        lines = [view, signed(f"median {median:.2g} tile widths")]
        if fit is not None and (found := record["fits"][fit]["correlation"]) is not None:
            lines.append(signed(f"correlation with the traced offset {found:.2f}"))
        file = record["traced"] if fit is None else record["fits"][fit]["file"]
        cell = {"image": name, "label": title, "lines": lines, "alt": f"{title}, {view}"}
        cells.append(cell | {"file": exr_link(file)})
    note = "Displacement towards the viewer’s azimuth, minus the median of each image."
    return {"cells": cells, "bar": color_bar("signed", "Displacement", scale, "tile widths", note)}

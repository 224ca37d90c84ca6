"""Offset images of the report: traced and learned displacements, each row with its own color scale."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_pipeline.compare.offsets import read_offset, towards_view
from mbtf_pipeline.formatting import direction, signed
from mbtf_pipeline.recipe import SceneView
from mbtf_pipeline.report.embed import Gallery, Pixels
from mbtf_pipeline.report.error_maps import common_scale, gradient, ticks
from mbtf_pipeline.report.pictures import ColorBar


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
    if not records:
        return []
    return [_row(folder, records, fit, gallery) for fit in (None, *records[0]["fits"])]


def _row(folder: Path, records: list[dict[str, Any]], fit: str | None, gallery: Gallery) -> dict[str, Any]:
    title = "Traced through the heights" if fit is None else f"Learned by {fit}"
    maps, medians, scale = displacements(folder, records, fit)
    cells = []
    for number, (record, values, median) in enumerate(zip(records, maps, medians, strict=True)):
        name = f"offset-{fit or 'traced'}-{number}"
        gallery.add_map(name, "signed", values / scale)
        lines = [f"view {direction(record['view'])}", signed(f"median {median:.2g} tile widths")]
        lines += _correlation(record, fit)
        alt = f"{title}, view {direction(record['view'])}"
        cells.append({"image": name, "label": title, "lines": lines, "alt": alt})
    note = "Displacement towards the viewer’s azimuth, minus the median of each image."
    bar = ColorBar("offset", "Displacement", gradient("signed"), ticks(-scale, scale), "tile widths", note)
    return {"cells": cells, "bar": bar}


def _correlation(record: Mapping[str, Any], fit: str | None) -> list[str]:
    found = None if fit is None else record["fits"][fit]["correlation"]
    return [] if found is None else [f"correlation with the traced offset {found:.2f}"]

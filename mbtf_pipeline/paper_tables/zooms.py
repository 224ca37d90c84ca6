"""Materials at several zooms: pictures and their errors by the width of the field of view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mbtf_pipeline.compare.perceptual_metrics import MEASURES
from mbtf_pipeline.formatting import estimate, levels
from mbtf_pipeline.paper_tables.cells import Cell, Column, Decibel, Figure, Table, mean_of
from mbtf_pipeline.paper_tables.figures import picture
from mbtf_pipeline.paper_tables.methods import mean_seen, visible_columns
from mbtf_pipeline.paper_tables.runs import Run, name_of

_KINDS = {"query": "M at each pixel’s footprint", "pixel": "filtered pixels"}


def zooms(runs: Sequence[Run]) -> list[Table]:
    """Errors at every width, against every kind of reference, means over views and lights."""
    kinds = list(dict.fromkeys(kind for run in runs for kind in run.comparison["kinds"]))
    columns = [
        Column("material", "material"),
        Column("tiles across", "tiles_across", digits="g"),
        Column("level", "level"),
        Column("method", "method"),
    ]
    for kind in kinds:
        columns += [
            Column(f"MSE against {_KINDS[kind]} [10⁻³/sr²]", f"mse_{kind}", 1e3, second="se"),
            Column(f"PSNR against {_KINDS[kind]}", f"psnr_{kind}", second="se"),
        ]
    columns += visible_columns()
    rows: list[list[Cell]] = []
    for run in runs:
        for tiles_across in _widths(run):
            chosen = [p for p in run.pictures if p["tiles_across"] == tiles_across]
            level = levels(chosen[0]["levels"], run.comparison["finest"])
            for fit in run.fits:
                row: list[Cell] = [name_of(run.material), float(tiles_across), level, fit]
                for kind in kinds:
                    row += _against(run, chosen, fit, kind)
                rows.append([*row, *(mean_seen(run, fit, m, chosen) for m in MEASURES)])
    text = (
        "The same view and light from near to far. M at each pixel’s footprint is what the fits are "
        "asked; the truly filtered pixel is what a camera sees, and differs from it where footprints are "
        "far from round. Pictures of one material share one exposure."
    )
    return [Table("zooms", "Materials at several zooms", text, columns, rows, figures=_figures(runs))]


def _widths(run: Run) -> list[float]:
    return list(dict.fromkeys(p["tiles_across"] for p in run.pictures))


def _against(run: Run, chosen: Sequence[dict[str, Any]], fit: str, kind: str) -> list[Cell]:
    if kind not in run.comparison["kinds"]:
        return [None, None]
    mse = mean_of([estimate(p["fits"][fit]["errors"][kind]["mse"]) for p in chosen])
    return [mse, Decibel.of(mse, run.comparison["white"])]


def _figures(runs: Sequence[Run]) -> list[tuple[str, list[Figure]]]:
    out: list[tuple[str, list[Figure]]] = []
    for run in runs:
        shown = [
            next(p for p in run.pictures if p["tiles_across"] == tiles_across)
            for tiles_across in _widths(run)
        ]
        lines = [f"{p['tiles_across']:g} tiles across" for p in shown]
        for kind in run.comparison["kinds"]:
            files = [p["references"][kind]["file"] for p in shown]
            out.append((f"{name_of(run.material)}: reference, {_KINDS[kind]}", _row(run, files, lines)))
        for fit in run.fits:
            files = [p["fits"][fit]["file"] for p in shown]
            out.append((f"{name_of(run.material)}: {fit}", _row(run, files, lines)))
    return out


def _row(run: Run, files: list[str], lines: list[str]) -> list[Figure]:
    return [Figure(picture(run.picture(f)), line) for f, line in zip(files, lines, strict=True)]

"""Materials at several zooms: images and their errors by width of the field of view."""

from __future__ import annotations

from collections.abc import Sequence

from mbtf_core.stats import Estimate
from mbtf_pipeline.formatting import levels
from mbtf_pipeline.papers.cells import (
    MATERIAL,
    METHOD,
    Column,
    Shown,
    Table,
    Thumbnail,
    preview,
    psnr_cell,
    rows_of,
)
from mbtf_pipeline.papers.methods import METRIC_COLUMNS, Pictures, picture_error
from mbtf_pipeline.papers.runs import FinishedRun

_KINDS = {"query": "M at each pixel’s footprint", "pixel": "filtered pixels"}
_TEXT = (
    "The same view and light from near to far. The fits approximate M at the footprint of each pixel. The "
    "filtered pixel is what a camera sees; the two differ for anisotropic footprints. All images of one "
    "material share one exposure."
)


def zooms(runs: Sequence[FinishedRun]) -> list[Table]:
    """Errors for every field of view and kind of reference, averaged over views and lights."""
    columns = [
        MATERIAL,
        Column("tiles across", "tiles_across", lambda *item: float(item[-1][0]["tiles_across"]), digits="g"),
        Column("level", "level", lambda run, _, shown: levels(shown[0]["levels"], run.comparison["finest"])),
        METHOD,
    ]
    for kind in dict.fromkeys(kind for run in runs for kind in run.comparison["kinds"]):
        columns += _errors(kind)
    columns += METRIC_COLUMNS
    items = [
        (run, fit, [p for p in run.pictures if p["tiles_across"] == width])
        for run in runs
        for width in _widths(run)
        for fit in run.fits
    ]
    rows = rows_of(columns, items)
    return [Table("zooms", "Materials at several zooms", _TEXT, columns, rows, images=_images(runs))]


def _errors(kind: str) -> list[Column]:
    """MSE and PSNR against one kind of reference, where a run has it."""

    def mse(run: FinishedRun, fit: str, shown: Pictures) -> Estimate | None:
        return picture_error(run, fit, "mse", shown, kind) if kind in run.comparison["kinds"] else None

    def psnr(run: FinishedRun, fit: str, shown: Pictures) -> Shown | None:
        found = mse(run, fit, shown)
        return None if found is None else psnr_cell(found, run.comparison["white"])

    return [
        Column(f"MSE against {_KINDS[kind]} [10⁻³/sr²]", f"mse_{kind}", mse, 1e3),
        Column(f"PSNR against {_KINDS[kind]}", f"psnr_{kind}", psnr),
    ]


def _widths(run: FinishedRun) -> list[float]:
    return list(dict.fromkeys(p["tiles_across"] for p in run.pictures))


def _images(runs: Sequence[FinishedRun]) -> list[tuple[str, list[Thumbnail]]]:
    out = []
    for run in runs:
        shown = [next(p for p in run.pictures if p["tiles_across"] == width) for width in _widths(run)]
        sources = [(f"reference, {_KINDS[kind]}", "references", kind) for kind in run.comparison["kinds"]]
        sources += [(fit, "fits", fit) for fit in run.fits]
        for title, group, name in sources:
            row = [
                preview(run.file(p[group][name]["file"]), f"{p['tiles_across']:g} tiles across")
                for p in shown
            ]
            out.append((f"{run.title}: {title}", row))
    return out

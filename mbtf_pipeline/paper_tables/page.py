"""The page of a paper recipe and its tables as CSV files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mbtf_core.atomic import write_text
from mbtf_core.errors import InputError
from mbtf_pipeline.compare.metrics import DEFINITIONS
from mbtf_pipeline.compare.st_lpips import weights_file
from mbtf_pipeline.paper_tables.ablations import ablations
from mbtf_pipeline.paper_tables.cells import Table
from mbtf_pipeline.paper_tables.independence import independence
from mbtf_pipeline.paper_tables.levels import levels
from mbtf_pipeline.paper_tables.methods import methods
from mbtf_pipeline.paper_tables.offsets import offsets
from mbtf_pipeline.paper_tables.recipe import RUNS
from mbtf_pipeline.paper_tables.runs import FinishedRun
from mbtf_pipeline.paper_tables.sizes import timing, weights
from mbtf_pipeline.paper_tables.zooms import zooms
from mbtf_pipeline.report.plots import ERROR_BAR_NOTE
from mbtf_pipeline.report.report import render

PAGE = "paper.html"
TABLES = "tables"
_MAKERS: dict[str, Callable[[Sequence[FinishedRun]], list[Table]]] = {
    "methods": methods,
    "levels": levels,
    "weights": weights,
    "ablations": ablations,
    "timing": timing,
    "offsets": offsets,
    "zooms": zooms,
    "independence": independence,
}


def read_runs(folder: Path, record: Mapping[str, Any]) -> list[FinishedRun]:
    """Read the finished runs of a paper recipe.

    Raises
    ------
    InputError : there is none, or one is corrupt
    """
    if not record["runs"]:
        raise InputError("contains no finished run", where=folder, hint="run the recipe again: it resumes")
    return [FinishedRun.read(r["material"], r["variant"], folder / RUNS / r["name"]) for r in record["runs"]]


def make_tables(names: Sequence[str], runs: Sequence[FinishedRun]) -> list[Table]:
    """All tables of these names."""
    return [table for name in names for table in _MAKERS[name](runs)]


def write_page(folder: Path, record: Mapping[str, Any]) -> tuple[Path, list[Path]]:
    """Write ``paper.html`` and ``tables/*.csv``; returns their paths.

    Raises
    ------
    InputError : a run is missing or corrupt
    """
    runs = read_runs(folder, record)
    tables = make_tables(record["tables"], runs)
    (folder / TABLES).mkdir(exist_ok=True)
    files = []
    for table in tables:
        files.append(folder / TABLES / f"{table.key}.csv")
        write_text(files[-1], table.csv())
    html = render(
        "paper.html",
        record=record,
        tables=tables,
        reports=[(r["name"].replace("_", " "), f"{RUNS}/{r['name']}/report.html") for r in record["runs"]],
        sizes=_sizes(runs),
        definitions=DEFINITIONS,
        error_bar_note=ERROR_BAR_NOTE,
        st_lpips=weights_file() is not None,
    )
    write_text(folder / PAGE, html)
    return folder / PAGE, files


def _sizes(runs: Sequence[FinishedRun]) -> dict[str, Any]:
    """Sizes of the first run, for the head of the page."""
    run = runs[0]
    splits = run.manifest["splits"]
    return {
        "resolution": 2 ** run.comparison["finest"],
        "train": splits["train"]["queries"],
        "spp": splits["train"]["spp"],
        "test": splits["test"]["queries"],
        "test_spp": splits["test"]["spp"],
        "pictures": len(run.pictures),
        "size": run.comparison["size"],
        "picture_spp": run.comparison["spp"],
        "training": max(r.seconds(fit) for r in runs for fit in r.fits),
    }

"""The page of a paper recipe, and one CSV file per table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mbtf_gen.atomic import write_text
from mbtf_gen.errors import InputError

from ..metrics import DEFINITIONS
from ..perceptual import weights_file
from ..plots import BARS_NOTE
from ..report import page_environment, template
from .ablations import ablations
from .cells import Table
from .independence import independence
from .levels import levels
from .methods import methods
from .offsets import offsets
from .runs import Run
from .sizes import timing, weights
from .suite import RUNS
from .zooms import zooms

PAGE = "paper.html"
TABLES = "tables"
_MAKERS: dict[str, Callable[[Sequence[Run]], list[Table]]] = {
    "methods": methods,
    "levels": levels,
    "weights": weights,
    "ablations": ablations,
    "timing": timing,
    "offsets": offsets,
    "zooms": zooms,
    "independence": independence,
}


def read_runs(folder: Path, record: Mapping[str, Any]) -> list[Run]:
    """Finished runs of a paper recipe.

    Raises
    ------
    InputError : there is none, or one is damaged
    """
    if not record["runs"]:
        raise InputError("has no finished run", where=folder, cure="run the recipe again: it resumes")
    return [Run.read(r["material"], r["variant"], folder / RUNS / r["name"]) for r in record["runs"]]


def make_tables(names: Sequence[str], runs: Sequence[Run]) -> list[Table]:
    """All tables of these names."""
    return [table for name in names for table in _MAKERS[name](runs)]


def write_page(folder: Path, record: Mapping[str, Any]) -> tuple[Path, list[Path]]:
    """Write ``paper.html`` and ``tables/*.csv``; returns their paths.

    Raises
    ------
    InputError : a run is missing or damaged
    """
    runs = read_runs(folder, record)
    tables = make_tables(record["tables"], runs)
    (folder / TABLES).mkdir(exist_ok=True)
    files = []
    for table in tables:
        files.append(folder / TABLES / f"{table.key}.csv")
        write_text(files[-1], table.csv())
    html = (
        page_environment()
        .from_string(template("paper.html"))
        .render(
            record=record,
            tables=tables,
            reports=[
                (r["name"].replace("_", " "), f"{RUNS}/{r['name']}/report.html") for r in record["runs"]
            ],
            sizes=_sizes(runs),
            definitions=DEFINITIONS,
            bars_note=BARS_NOTE,
            learned=weights_file() is not None,
            style=template("report.css"),
        )
    )
    write_text(folder / PAGE, html)
    return folder / PAGE, files


def _sizes(runs: Sequence[Run]) -> dict[str, Any]:
    """What was computed, for the head of the page."""
    run = runs[0]
    splits = run.manifest["splits"]
    return {
        "finest": 2 ** run.comparison["finest"],
        "train": splits["train"]["queries"],
        "spp": splits["train"]["spp"],
        "test": splits["test"]["queries"],
        "test_spp": splits["test"]["spp"],
        "pictures": len(run.pictures),
        "size": run.comparison["size"],
        "picture_spp": run.comparison["spp"],
        "training": max(float(r.size(fit)["training_seconds"]) for r in runs for fit in r.fits),
    }

"""Pages of the runs of several materials: cards of a library, or tables of a paper."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from mbtf_core.files.editable import write_document
from mbtf_core.units import clock
from mbtf_pipeline.collection.finished_run import FinishedRun, each_fit
from mbtf_pipeline.collection.paper_tables import ablations, levels, methods, timing
from mbtf_pipeline.collection.ranking import ranking
from mbtf_pipeline.collection.recipes import Published
from mbtf_pipeline.compare.metrics import DEFINITIONS
from mbtf_pipeline.compare.perceptual_metrics import weights_file
from mbtf_pipeline.report.images import file_uri
from mbtf_pipeline.report.plots import ERROR_BAR_NOTE
from mbtf_pipeline.report.report import render
from mbtf_pipeline.stages import REPORT, VIEWER
from mbtf_pipeline.tables import estimate, estimate_text

# Sub-folders of the runs, and of the CSV files.
RUNS, TABLES = "runs", "tables"
# Pixels along a side of a thumbnail.
_SIZE = 160
# States of a material in the order of the page, and their text.
_STATES = {"done": "done", "failed": "failed", "pending": "not run yet"}
_TABLES = {f.__name__: f for f in (methods, levels, ablations, timing, ranking)}


def write_page(folder: Path, record: Mapping[str, Any]) -> tuple[Path, list[Path]]:
    """Write the page of a library, or page and tables of a paper, from the content of ``collection.json`` in
    the folder of all runs; returns the HTML file and the CSV files."""
    if "tables" not in record["recipe"]:
        page = folder / "library.html"
        write_document(page, library_page(record, folder / RUNS))
        return page, []
    html, tables = paper_page(record, folder / RUNS)
    (folder / TABLES).mkdir(exist_ok=True)
    for name, text in tables.items():
        write_document(folder / TABLES / f"{name}.csv", text)
    page = folder / "paper.html"
    write_document(page, html)
    return page, [folder / TABLES / f"{name}.csv" for name in tables]


def library_page(record: Mapping[str, Any], runs: Path) -> str:
    """HTML of a library, from its record and the folder of its runs."""
    cards = [_card(run, runs / run["name"]) for run in record["runs"]]
    spent: Counter[str] = Counter()
    for run in record["runs"]:
        spent.update(run["seconds"] if run["state"] == "done" else {})
    return render(
        "library.html",
        record=record,
        # The largest errors first: they are what one looks for. Then failures, then the rest.
        cards=sorted(cards, key=lambda c: (c["rank"], -c["error_value"], c["name"])),
        counts=Counter(run["state"] for run in record["runs"]),
        spent=_times(spent),
    )


def _card(run: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """What the page shows of one material."""
    done = run["state"] == "done"
    fits = []
    for name, found in run["fits"].items() if done else ():
        error = estimate(found["unexplained"])
        value = error.value if math.isfinite(error.value) else 0.0
        image = _thumbnail(folder / found["picture"])
        fits.append({"name": name, "error": estimate_text(error), "value": value, "image": image})
    seconds = run["seconds"] if done else {}
    pages = [
        page for page in (("report", REPORT), ("viewer", VIEWER)) if done and (folder / page[1]).is_file()
    ]
    return {
        "name": run["name"],
        "path": run["path"],
        "state": _STATES[run["state"]],
        "rank": list(_STATES).index(run["state"]),
        "problem": run["error"] if run["state"] == "failed" else "",
        "fits": fits,
        "error_value": max((fit["value"] for fit in fits), default=0.0),
        "reference": _thumbnail(folder / run["reference"]) if done else None,
        "seconds": sum(seconds.values()),
        "times": _times(seconds),
        "links": [(title, f"{RUNS}/{folder.name}/{file}") for title, file in pages],
    }


def _times(seconds: Mapping[str, float]) -> str:
    """Times of stages in words, and their sum."""
    parts = ", ".join(f"{stage} {clock(s)}" for stage, s in seconds.items())
    return f"{clock(sum(seconds.values()))}: {parts}" if parts else ""


def _thumbnail(path: Path) -> str | None:
    """A small picture; None where it is missing or damaged."""
    try:
        return _small(path, path.stat().st_mtime_ns)
    except OSError:
        return None


@lru_cache(maxsize=4096)
def _small(path: Path, changed: int) -> str:
    """A picture of a date."""
    return file_uri(path, _SIZE)


def paper_page(record: Mapping[str, Any], folder: Path) -> tuple[str, dict[str, str]]:
    """HTML of a paper, and its tables as CSV by name, from its record and the folder of its runs."""
    recipe, ended = record["recipe"], [run for run in record["runs"] if run["state"] == "done"]
    runs = [FinishedRun.read(run["material"], run["variant"], folder / run["name"]) for run in ended]
    published = [Published.model_validate(one) for one in recipe["published"]]
    makers = [_TABLES[name] for name in recipe["tables"]] if runs else []
    tables = [table for make in makers for table in make(runs, published)]
    html = render(
        "paper.html",
        record=record,
        tables=tables,
        runs=[run["name"] for run in ended],
        planned=sum(run["state"] != "skipped" for run in record["runs"]),
        failed={run["name"]: run["error"] for run in record["runs"] if run["state"] == "failed"},
        skipped=[run["name"] for run in record["runs"] if run["state"] == "skipped"],
        first=runs[0] if runs else None,
        training=max((run.fit(fit)["training_seconds"] for run, fit in each_fit(runs)), default=0.0),
        definitions=DEFINITIONS,
        error_bar_note=ERROR_BAR_NOTE,
        st_lpips=weights_file() is not None,
    )
    return html, {table.key: table.csv() for table in tables}

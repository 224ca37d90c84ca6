"""The page of a study ``cost.html``, its plots as PNG, and ``cost.csv``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mbtf_core.files.atomic import write_text
from mbtf_core.stats import Estimate
from mbtf_core.units import clock
from mbtf_pipeline.cost.figures import (
    NOISE_AXIS,
    TIME_AXIS,
    Figures,
    bias_figures,
    front_figures,
    lines,
)
from mbtf_pipeline.cost.measurements import ESTIMATES, Measurement
from mbtf_pipeline.cost.pareto import extrapolation, pareto_front
from mbtf_pipeline.cost.study import STUDY, Study
from mbtf_pipeline.report.report import render
from mbtf_pipeline.tables import Cell, Column, Table, is_significant, rows_of

CSV_NAME, PAGE_NAME = "cost.csv", "cost.html"
_DETAILS = (
    "queries",
    "spp",
    "generation_seconds",
    "training_seconds",
    "total_seconds",
    "evaluation_ms_1080p",
    "bytes",
    "seeds",
)


def _column(name: str) -> Column:
    """A column of the CSV file: a field of a measurement, or one of its details."""

    def cell(m: Measurement) -> Cell:
        if name in _DETAILS:
            return m.details.get(name)
        found: Cell = getattr(m, name)
        # A number that was not measured has an error column all the same.
        return Estimate(math.nan, math.nan, 0) if found is None else found

    return Column(name, name, cell)


_CSV = [_column(name) for name in ("study", "series", "name", *ESTIMATES, *_DETAILS, "command")]


def to_csv(found: Sequence[Measurement]) -> str:
    """One row per configuration; ``_se`` are standard errors, empty cells were not measured."""
    return Table("cost", "", _CSV, rows_of(_CSV, ([m] for m in found))).csv()


def _percent(e: Estimate | None) -> str:
    if e is None or not math.isfinite(e.value):
        return "–"
    if e.value == e.error == 0:
        return "0 %"
    return f"{e.scaled(100.0)} %" if is_significant(e) else f"< {100 * 2 * max(e.error, e.value):.2g} %"


def _of(title: str, text: Callable[[Measurement], str]) -> Column:
    return Column(title, "", text)


_GENERATOR = [
    _of("configuration", lambda m: m.title),
    _of("seconds per million queries", lambda m: f"{m.seconds}"),
    _of("bias", lambda m: _percent(m.bias)),
    _of("noise", lambda m: _percent(m.noise)),
    _of("error", lambda m: _percent(m.error)),
    _of("command", lambda m: m.command),
]
_RUNS = [
    _of("run", lambda m: m.title),
    _of("queries × paths", lambda m: f"{m.details['queries'] / 1e6:.2f} M × {m.details['spp']:g}"),
    _of("generating, s", lambda m: f"{m.details['generation_seconds']:.1f}"),
    _of("training, s", lambda m: f"{m.details['training_seconds']:.1f}"),
    _of("total, s", lambda m: f"{m.details['total_seconds']:.1f}"),
    _of("unexplained variance", lambda m: f"{m.error}" if math.isfinite(m.error.value) else "–"),
    _of("seeds", lambda m: f"{m.details['seeds']:g}"),
    _of("1080p, ms", lambda m: f"{m.details['evaluation_ms_1080p']:.0f}"),
    _of("MB", lambda m: f"{m.details['bytes'] / 1e6:.2f}"),
    _of("command", lambda m: m.command),
]


class _Section(NamedTuple):
    title: str
    text: str
    figures: Figures
    columns: Sequence[Column] = tuple(_GENERATOR)


_SECTIONS = {
    "paths": _Section(
        "Paths per query",
        "More paths reduce the noise and leave no bias. Queries get equally many paths, more where a pilot "
        "expects more noise, or as many as a target error takes.",
        lines(TIME_AXIS, NOISE_AXIS),
    ),
    "effects": _Section(
        "Effects",
        "The time that each effect takes, and the bias of leaving it out, which more paths do not reduce.",
        bias_figures,
    ),
    "mesh": _Section(
        "Mesh resolution",
        "Bias against the finest mesh of this plot. A coarser mesh is a different, smoother surface.",
        bias_figures,
    ),
    "interactions": _Section(
        "Surface interactions",
        "A limit on the interactions of a path saves time and adds a bias; no limit adds none.",
        bias_figures,
    ),
}


def _table(columns: Sequence[Column], found: Sequence[Measurement]) -> dict[str, Any]:
    return Table("", "", columns, rows_of(columns, ([m] for m in found))).for_page()


def complete_runs(found: Sequence[Measurement]) -> list[Measurement]:
    """The runs from height map to material, among measurements of all kinds."""
    return [m for m in found if m.study == "whole"]


def _sections(study: Study) -> list[dict[str, Any]]:
    runs = complete_runs(study.measurements)
    front = pareto_front(runs)
    front_section = _Section("All runs", _front_text(front), front_figures, _RUNS)
    shown = {name: [m for m in study.measurements if m.study == name] for name in _SECTIONS}
    shown["front"] = runs
    return [
        {
            "id": name,
            "title": section.title,
            "text": section.text,
            "figures": section.figures(shown[name], study.folder / f"{name}.png"),
            "table": _table(section.columns, front if name == "front" else shown[name]),
        }
        for name, section in {"front": front_section, **_SECTIONS}.items()
        if shown[name]
    ]


def _front_text(front: Sequence[Measurement]) -> str:
    text = "Error over total time, and the Pareto front: the runs that no other one beats in both."
    further = extrapolation(front)
    if further is None:
        return text
    seconds, exponent = further
    return (
        f"{text} Extrapolation: we fit a power law to the last three points of the front. The error falls as "
        f"time to the power -{exponent}, so halving the last error takes about {clock(seconds)} more. "
        "Expect longer, because gains shrink with time."
    )


def write_page(study: Study) -> Path:
    """Write CSV, page and plots into the study's folder, and a summary into its record; returns the path of
    the page."""
    write_text(study.folder / CSV_NAME, to_csv(study.measurements))
    html = render(
        "cost.html",
        study=study.description,
        time=clock(study.description["time"]),
        sections=_sections(study),
        skipped=study.skipped,
        failed=study.failed,
        deviation=None if study.deviation is None else f"{study.deviation.scaled(100.0)} %",
        seeds=round(max((m.details.get("seeds", 0.0) for m in study.measurements), default=0.0)),
    )
    path = study.folder / PAGE_NAME
    write_text(path, html)
    summary = {
        "seed_deviation": None if study.deviation is None else study.deviation.as_dict(),
        "skipped": study.skipped,
        "failed": study.failed,
    }
    STUDY.write(study.folder, {**study.description, "summary": summary})
    return path

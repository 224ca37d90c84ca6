"""The page of a study ``cost.html``, its plots as PNG, and ``cost.csv``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from mbtf_core.atomic import write_json, write_text
from mbtf_core.stats import Estimate
from mbtf_core.units import clock
from mbtf_pipeline.cost_study.figures import (
    bias_figures,
    data_figures,
    front_figures,
    model_figures,
    noise_figures,
)
from mbtf_pipeline.cost_study.measurements import HALF_WIDTH, NORMAL, Measurement
from mbtf_pipeline.cost_study.pareto import extrapolation, pareto_front
from mbtf_pipeline.cost_study.study import STUDY_NAME, Study
from mbtf_pipeline.cost_study.tables import generator_table, run_table, to_csv
from mbtf_pipeline.report.report import render

CSV_NAME, PAGE_NAME = "cost.csv", "cost.html"


class _Section(NamedTuple):
    title: str
    text: str
    figures: Callable[[Sequence[Measurement], str, Path], list[dict[str, Any]]]
    table: Callable[[Sequence[Measurement]], dict[str, Any]] = generator_table


_SECTIONS = {
    "data": _Section(
        "Queries or paths?",
        "Training data of equal total paths, divided among many noisy or few clean queries. Every fit trains "
        "equally long.",
        data_figures,
        run_table,
    ),
    "models": _Section(
        "Models and sizes",
        "Models and network sizes trained on one data set: error over training time and over the time of an "
        "evaluation.",
        model_figures,
        run_table,
    ),
    "paths": _Section(
        "Paths per query",
        "More paths reduce the noise and leave no bias. Queries get equally many paths, more where a pilot "
        "expects more noise, or as many as a target error takes.",
        noise_figures,
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


def whole_runs(found: Sequence[Measurement]) -> list[Measurement]:
    """The runs of all comparisons, by their total time."""
    return [
        replace(m, seconds=Estimate(m.details["total_seconds"], 0.0, 1))
        for m in found
        if "total_seconds" in m.details
    ]


def narrow_errors(found: Sequence[Measurement]) -> tuple[int, int]:
    """(errors whose 95 % interval is within `HALF_WIDTH` of them, all errors)."""
    widths = [NORMAL * m.error.relative_error for m in found if m.error.value > 0]
    return sum(w <= HALF_WIDTH for w in widths), len(widths)


def _section(study: Study, name: str) -> dict[str, Any] | None:
    found = [m for m in study.measurements if m.study == name]
    if not found:
        return None
    section = _SECTIONS[name]
    return {
        "id": name,
        "title": section.title,
        "text": section.text,
        "figures": section.figures(found, name, study.folder),
        "table": section.table(found),
        "open": False,
    }


def _front_section(study: Study) -> dict[str, Any] | None:
    runs = whole_runs(study.measurements)
    if not runs:
        return None
    front = pareto_front(runs)
    text = "All runs, and the Pareto front: the runs that no other one beats in both time and error."
    further = extrapolation(front)
    if further is not None:
        seconds, exponent = further
        text += (
            " Extrapolation: we fit a power law to the last three points of the front. The error falls as "
            f"time to the power -{exponent}, so halving the last error takes about {clock(seconds)} more. "
            "Expect longer, because gains shrink with time."
        )
    return {
        "id": "front",
        "title": "Whole runs",
        "text": text,
        "figures": front_figures(runs, study.folder),
        "table": run_table(front),
        "open": True,
    }


def write_page(study: Study) -> Path:
    """Write CSV, page and plots into the study's folder, and a summary into its record; returns the path of
    the page."""
    write_text(study.folder / CSV_NAME, to_csv(study.measurements))
    sections = [_front_section(study), *(_section(study, name) for name in _SECTIONS)]
    runs = whole_runs(study.measurements)
    narrow, known = narrow_errors(study.measurements)
    narrow_runs, known_runs = narrow_errors(runs)
    deviation = None if study.deviation is None else f"{study.deviation.scaled(100.0)} %"
    html = render(
        "cost.html",
        study=study.description,
        time=clock(study.description["time"]),
        sections=[s for s in sections if s is not None],
        skipped=study.skipped,
        failed=study.failed,
        runs=bool(runs),
        deviation=deviation,
        seeds=round(max((m.details.get("seeds", 1.0) for m in runs), default=1.0)),
        narrow=narrow,
        known=known,
        refine=narrow_runs < known_runs,
    )
    path = study.folder / PAGE_NAME
    write_text(path, html)
    summary = {
        "narrow": narrow,
        "known": known,
        "seed_deviation": None if study.deviation is None else study.deviation.as_dict(),
        "skipped": study.skipped,
        "failed": study.failed,
    }
    write_json(study.folder / STUDY_NAME, {**study.description, "summary": summary})
    return path

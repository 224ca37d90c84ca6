"""What a study shows: ``cost.csv``, ``cost.html``, and its plots as PNG."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mbtf_core.atomic import write_json, write_text
from mbtf_core.console import clock
from mbtf_core.stats import Estimate
from mbtf_pipeline.cost_study.figures import (
    bias_figures,
    count_figures,
    data_figures,
    fit_figures,
    front_figures,
    noise_figures,
)
from mbtf_pipeline.cost_study.measurements import HALF_WIDTH, NORMAL, Point
from mbtf_pipeline.cost_study.pareto import marginal_price, pareto_front, weighted_line
from mbtf_pipeline.cost_study.seed_variance import FITTED, Scatter
from mbtf_pipeline.cost_study.study import STUDY_NAME, Study
from mbtf_pipeline.cost_study.tables import chain_table, generator_table, to_csv
from mbtf_pipeline.report.report import page_environment, template

CSV_NAME, PAGE_NAME = "cost.csv", "cost.html"

Figures = Callable[[Sequence[Point], str, Path], list[dict[str, Any]]]
Table = Callable[[Sequence[Point]], dict[str, Any]]
# Studies: title, what to read from the plot, its plots, its table.
_STUDIES: dict[str, tuple[str, str, Figures, Table]] = {
    "data": (
        "Queries or paths?",
        "Data of equal numbers of paths, divided among many noisy or few clean queries; one fit of equal "
        "length each.",
        data_figures,
        chain_table,
    ),
    "fit": (
        "Models and sizes",
        "On one data set: what training time buys for each model and size, what they cost when they are "
        "evaluated, and how large they are.",
        fit_figures,
        chain_table,
    ),
    "paths": (
        "Paths per query",
        "More paths buy less noise; there is no bias to buy off. Independent samples would fall along a "
        "slope of −½ (error against seconds); better points fall faster.",
        noise_figures,
        generator_table,
    ),
    "adaptive": (
        "The same paths for all, or as many as each needs",
        "Equal numbers of paths, numbers in proportion to the noise that a pilot expects (what runs do by "
        "themselves), and as many as a target error takes, the queries’ own pilots included.",
        count_figures,
        generator_table,
    ),
    "effects": (
        "Effects",
        "What each effect costs in time, and what leaving it out costs in accuracy: its bias does not go "
        "away with more paths.",
        bias_figures,
        generator_table,
    ),
    "bounces": (
        "Surface interactions",
        "A cap saves time and leaves a bias; no limit leaves none.",
        bias_figures,
        generator_table,
    ),
    "mesh": (
        "Mesh",
        "Bias against the finest mesh that was tried. It is part of what the material is: a coarser mesh is "
        "another, smoother surface.",
        bias_figures,
        generator_table,
    ),
    "light": (
        "Width of the light",
        "Another width is another quantity: a wider lobe blurs highlights and shadows (bias against the "
        "recipe’s width), and has less noise.",
        bias_figures,
        generator_table,
    ),
}


def whole_chains(points: Sequence[Point]) -> list[Point]:
    """All chains that were measured, whatever their study, by what they cost in all."""
    return [
        replace(p, seconds=Estimate(p.details["total_seconds"], 0.0, 1))
        for p in points
        if "total_seconds" in p.details and p.study != "seeds"
    ]


def paths_slope(points: Sequence[Point]) -> Estimate | None:
    """Power of the number of paths with which the noise's variance falls, from a line through logarithms
    weighted by their error bars; None where there are fewer than three."""
    known = [
        (math.log(p.setting["queries.spp"]), 2 * math.log(p.noise.value), 2 * p.noise.relative_error)
        for p in points
        if p.study == "paths" and p.noise is not None and p.noise.value > 0 and p.noise.error > 0
    ]
    if len(known) < 3:
        return None
    return weighted_line(*zip(*known, strict=True))


def half_widths(points: Sequence[Point]) -> tuple[int, int]:
    """(errors whose 95 % interval is within `HALF_WIDTH` of them, all)."""
    widths = [NORMAL * p.error.relative_error for p in points if p.study != "seeds" and p.error.value > 0]
    return sum(w <= HALF_WIDTH for w in widths), len(widths)


def _part(study: Study, name: str) -> dict[str, Any] | None:
    points = [p for p in study.points if p.study == name]
    if not points:
        return None
    title, text, figures, table = _STUDIES[name]
    if name == "paths" and (slope := paths_slope(points)) is not None:
        text += (
            f" Here the noise’s variance falls with the power {slope.scaled(-1.0)} of the number of paths."
        )
    return {
        "id": name,
        "title": title,
        "text": text,
        "figures": figures(points, name, study.folder),
        "table": table(points),
        "open": False,
    }


def _front_part(study: Study) -> dict[str, Any] | None:
    chains = whole_chains(study.points)
    if not chains:
        return None
    front = pareto_front(chains)
    price = marginal_price(front)
    text = "Every chain that was measured, and those that nothing beats in both time and error."
    if price is not None:
        seconds, power = price
        text += (
            f" At the front’s end the error falls with the power {power} of time: halving the last one’s "
            f"would take about {clock(seconds)} more, and longer where gains shrink, as they do."
        )
    return {
        "id": "front",
        "title": "The whole chain",
        "text": text,
        "figures": front_figures(chains, study.folder),
        "table": chain_table(front),
        "open": True,
    }


def _scatter_text(scatter: Scatter | None, chains: bool) -> str:
    """What the bars of chains hold besides that of the test queries."""
    if scatter is not None:
        return (
            "; those of chains hold the scatter between seeds of data and fit, also where chains share their "
            f"data: {scatter.describe()}"
        )
    if chains:
        return (
            "; those of chains hold the test queries alone: too few seeds are known to tell how far chains "
            "scatter, so their bars are too narrow"
        )
    return ""


def write_page(study: Study) -> Path:
    """Write CSV, page and pictures into the study's folder, and what they say together into its record;
    returns the page's path."""
    write_text(study.folder / CSV_NAME, to_csv(study.points))
    parts = [_front_part(study), *(_part(study, name) for name in _STUDIES)]
    held, known = half_widths(study.points)
    fitted = [p for p in study.points if p.study in FITTED]
    narrow, chains = half_widths(fitted)
    seeds = max((p.details.get("seeds", 1.0) for p in study.points), default=1.0)
    html: str = (
        page_environment()
        .from_string(template("cost.html"))
        .render(
            style=template("report.css"),
            study=study.description,
            budget=clock(study.description["budget"]),
            seeds=round(seeds),
            parts=[p for p in parts if p is not None],
            skipped=study.skipped,
            scatter=_scatter_text(study.scatter, bool(fitted)),
            widths=f"{held} of {known} errors are known to within a tenth (95 %).",
            wide=study.scatter is not None and narrow < chains,
            failed=study.failed,
            tests=clock(tests) if (tests := study.test_seconds or 0.0) >= 1.0 else None,
        )
    )
    path = study.folder / PAGE_NAME
    write_text(path, html)
    summary = {
        "known_to_a_tenth": held,
        "known": known,
        "scatter": None if study.scatter is None else study.scatter.describe(),
        "skipped": study.skipped,
        "failed": study.failed,
    }
    write_json(study.folder / STUDY_NAME, {**study.description, "summary": summary})
    return path

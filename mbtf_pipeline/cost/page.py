"""What a study shows: ``cost.csv``, ``cost.html``, and its plots as PNG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mbtf_gen.atomic import write_text
from mbtf_gen.console import clock

from ..plots import Cloud, scatter
from ..report import page_environment, template
from .front import marginal_price, pareto_front
from .points import Point
from .study import Study
from .tables import chain_table, generator_table, to_csv

CSV_NAME, PAGE_NAME = "cost.csv", "cost.html"

# Studies of the generator: title, and what to read from the plot.
_GENERATOR = {
    "paths": (
        "Paths per query",
        "More paths buy less noise; there is no bias to buy off. Independent samples would fall along a "
        "slope of −½ (error against seconds); better points fall faster.",
    ),
    "effects": (
        "Effects",
        "What each effect costs in time, and what leaving it out costs in accuracy: its bias does not go "
        "away with more paths.",
    ),
    "bounces": ("Surface interactions", "A cap saves time and leaves a bias; no limit leaves none."),
    "mesh": (
        "Mesh",
        "Bias against the finest mesh that was tried. It is part of what the material is: a coarser mesh is "
        "another, smoother surface.",
    ),
    "light": (
        "Width of the light",
        "Another width is another quantity: a wider lobe blurs highlights and shadows (bias against the "
        "recipe’s width), and has less noise.",
    ),
    "adaptive": ("Adaptive paths", "Paths chosen per query for a target error, against the same for all."),
}
_CHAINS = {
    "data": (
        "Queries or paths?",
        "Data of equal numbers of paths, divided among many noisy or few clean queries; one fit of equal "
        "length each.",
        "seconds of generating",
    ),
    "fit": (
        "Models and sizes",
        "On one data set: what training time buys for each model and size.",
        "seconds of training",
    ),
}


def _clouds(points: Sequence[Point], *, parts: bool) -> list[Cloud]:
    """Points as clouds: total error, or noise and bias apart."""
    if not parts:
        names = list(dict.fromkeys(p.series for p in points))
        return [_cloud(n, [p for p in points if p.series == n], "error") for n in names]
    return [
        _cloud("bias, where it is told from zero", [p for p in points if _told(p)], "bias"),
        _cloud("noise", points, "noise", hollow=True, labelled=False),
    ]


def _told(point: Point) -> bool:
    return point.bias is not None and point.bias.value > 2 * point.bias.error


def _cloud(
    name: str, points: Sequence[Point], part: str, *, hollow: bool = False, labelled: bool = True
) -> Cloud:
    ordered = sorted(points, key=lambda p: p.seconds.value)
    estimates = [getattr(p, part) for p in ordered]
    return Cloud(
        name,
        [p.seconds.value for p in ordered],
        [e.value for e in estimates],
        [p.seconds.error for p in ordered],
        [e.error if math.isfinite(e.error) else 0.0 for e in estimates],
        [p.name if labelled else "" for p in ordered],
        joined=part == "error",
        hollow=hollow,
    )


def _generator_part(study: Study, name: str) -> dict[str, Any] | None:
    points = [p for p in study.points if p.study == name]
    if not points:
        return None
    title, text = _GENERATOR[name]
    parts = name not in ("paths", "adaptive")
    clouds = [c for c in _clouds(points, parts=parts) if len(c.x)]
    svg = scatter(
        clouds,
        "seconds per million queries",
        "RMS error relative to the mean value",
        f"cost {name}",
        png=study.folder / f"{name}.png",
    )
    return {"id": name, "title": title, "text": text, "svg": svg, "table": generator_table(points)}


def _chain_part(study: Study, name: str) -> dict[str, Any] | None:
    points = [p for p in study.points if p.study == name]
    if not points:
        return None
    title, text, x = _CHAINS[name]
    svg = scatter(
        _clouds(points, parts=False),
        x,
        "unexplained variance of test queries",
        f"cost {name}",
        png=study.folder / f"{name}.png",
    )
    return {"id": name, "title": title, "text": text, "svg": svg, "table": chain_table(points)}


def whole_chains(points: Sequence[Point]) -> list[Point]:
    """All chains that were measured, whatever their study, by what they cost in all."""
    from dataclasses import replace

    from mbtf_gen.stats import Estimate

    return [
        replace(p, seconds=Estimate(p.details["total_seconds"], 0.0, 1))
        for p in points
        if "total_seconds" in p.details
    ]


def _front_part(study: Study) -> dict[str, Any] | None:
    chains = whole_chains(study.points)
    if not chains:
        return None
    front = pareto_front(chains)
    price = marginal_price(front)
    svg = scatter(
        _clouds(chains, parts=False),
        "seconds in all, from height map to material",
        "unexplained variance of test queries",
        "cost front",
        front=[(p.seconds.value, p.error.value) for p in front],
        png=study.folder / "front.png",
    )
    text = "Every chain that was measured, and those that nothing beats in both time and error."
    if price is not None:
        seconds, power = price
        text += (
            f" Along the front the error falls with the power {power:.2f} of time: halving the last one’s "
            f"would take about {clock(seconds)} more."
        )
    return {"id": "front", "title": "The whole chain", "text": text, "svg": svg, "table": chain_table(front)}


def write_page(study: Study) -> Path:
    """Write CSV, page and pictures into the study's folder; returns the page's path."""
    write_text(study.folder / CSV_NAME, to_csv(study.points))
    parts = [
        _front_part(study),
        *(_chain_part(study, name) for name in _CHAINS),
        *(_generator_part(study, name) for name in _GENERATOR),
    ]
    html: str = (
        page_environment()
        .from_string(template("cost.html"))
        .render(
            style=template("report.css"),
            study=study.description,
            budget=clock(study.description["budget"]),
            parts=[p for p in parts if p is not None],
            skipped=study.skipped,
        )
    )
    path = study.folder / PAGE_NAME
    write_text(path, html)
    return path

"""The page of a study ``cost.html``, its plots as PNG, and ``cost.csv``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

from mbtf_core.files.atomic import write_text
from mbtf_core.units import clock
from mbtf_pipeline.cost.analysis import extrapolation, pareto_front
from mbtf_pipeline.cost.measurement import Measurement
from mbtf_pipeline.cost.study import Study
from mbtf_pipeline.number_text import is_significant
from mbtf_pipeline.report.plots import Series, plot
from mbtf_pipeline.report.report import render
from mbtf_pipeline.tables import Column, Table, rows_of

CSV_NAME, PAGE_NAME = "cost.csv", "cost.html"
_NOISE_AXIS = "RMS error relative to the mean value"
# Of the generator's comparisons: title, text, and whether the bias is shown.
_COMPARISONS = {
    "paths": (
        "Paths per query",
        "More paths reduce the noise and leave no bias. Queries get equally many paths, more where a pilot "
        "expects more noise, or as many as a target error takes.",
        False,
    ),
    "effects": (
        "Effects",
        "The time that each effect takes, and the bias of leaving it out, which more paths do not reduce.",
        True,
    ),
    "mesh": (
        "Mesh resolution",
        "Bias against the finest mesh of this plot. A coarser mesh is a different, smoother surface.",
        True,
    ),
    "interactions": (
        "Surface interactions",
        "A limit on the interactions of a path saves time and adds a bias; no limit adds none.",
        True,
    ),
}


def _field(title: str, name: str, **options: Any) -> Column:
    return Column(title, name, attrgetter(name), **options)


def _detail(title: str, name: str, **options: Any) -> Column:
    return Column(title, name, lambda m: m.details.get(name), **options)


_TITLE = Column("configuration", "", lambda m: ", ".join(filter(None, (m.series, m.name))))
_COMMAND = _field("command", "command")
_PARTS = [_field(f"{name}, %", name, factor=100.0) for name in ("bias", "noise", "error")]
_SECONDS = _field("seconds per million queries", "seconds")
_DETAILS = [
    _detail("million queries", "queries", factor=1e-6, digits=".2f"),
    _detail("paths each", "spp", digits="g"),
    _detail("generating, s", "generation_seconds", digits=".1f"),
    _detail("training, s", "training_seconds", digits=".1f"),
    _detail("total, s", "total_seconds", digits=".1f"),
    _detail("1080p, ms", "evaluation_ms_1080p", digits=".0f"),
    _detail("MB", "bytes", factor=1e-6, digits=".2f"),
    _detail("seeds", "seeds", digits="g"),
]
_GENERATOR = [_TITLE, _SECONDS, *_PARTS, _COMMAND]
_RUNS = [_TITLE, *_DETAILS, _field("unexplained variance", "error"), _COMMAND]
_NAMES = [_field("", name) for name in ("study", "series", "name")]
_CSV = [*_NAMES, _SECONDS, *reversed(_PARTS), *_DETAILS, _COMMAND]


def _table(columns: Sequence[Column], found: Sequence[Measurement]) -> Table:
    return Table("cost", "", "", columns, rows_of(columns, ([m] for m in found)))


def to_csv(found: Sequence[Measurement]) -> str:
    """One row per configuration; ``_se`` are standard errors, empty cells were not measured."""
    return _table(_CSV, found).csv()


def _series(
    name: str,
    found: Sequence[Measurement],
    part: str = "error",
    label: Callable[[Measurement], str] = attrgetter("name"),
    **options: Any,
) -> Series:
    """A part of the error over time."""
    usable = [m for m in found if math.isfinite(getattr(m, part).value) and math.isfinite(m.seconds.value)]
    usable.sort(key=lambda m: m.seconds.value)
    x, y = [m.seconds for m in usable], [getattr(m, part) for m in usable]
    (xs, ys), (dx, dy) = ([[getattr(e, k) for e in axis] for axis in (x, y)] for k in ("value", "error"))
    return Series(name, xs, ys, dy, dx, [label(m) for m in usable], **options)


def _figure(
    series: Sequence[Series], x: str, y: str, png: Path, caption: str = "", **options: Any
) -> dict[str, str]:
    shown = [one for one in series if one.x]
    if not shown:
        return {"svg": "", "caption": f"No {y} could be measured."}
    return {"svg": plot(shown, x, y, f"cost {png.stem}", png=png, **options), "caption": caption}


def _front_section(runs: Sequence[Measurement], png: Path) -> dict[str, Any]:
    """All runs and their Pareto front, whose points have names."""
    front = pareto_front(runs)
    text = "Error over total time, and the Pareto front: the runs that no other one beats in both."
    if (further := extrapolation(front)) is not None:
        text += (
            " Extrapolation: we fit a power law to the last three points of the front. The error falls as "
            f"time to the power -{further[1]}, so halving the last error takes about {clock(further[0])} "
            "more. Expect longer, because gains shrink with time."
        )

    def name(m: Measurement) -> str:
        return f"{m.details['queries'] / 1e6:.2g} M × {m.details['spp']:g}" if m in front else ""

    axes = "seconds in total, from height map to material", "unexplained variance of test queries"
    caption = "Names on the front: training queries × paths per query."
    stepped = [(m.seconds.value, m.error.value) for m in front]
    series = [_series("complete runs", runs, label=name, style="points")]
    return {
        "title": "All runs",
        "text": text,
        "figure": _figure(series, *axes, png, caption, front=stepped),
        "table": _table(_RUNS, front).for_page(),
    }


def _generator_section(kind: str, found: Sequence[Measurement], png: Path) -> dict[str, Any]:
    """Error over time of one comparison of the generator, split into bias and noise where there is a bias."""
    title, text, split = _COMPARISONS[kind]
    found = sorted(found, key=lambda m: (m.series, m.seconds.value))
    caption = ""
    if split:
        biased = [m for m in found if m.bias and is_significant(m.bias)]
        unbiased = [m for m in found if m not in biased]
        series = [
            _series("bias", biased, "bias", style="points"),
            _series(
                "noise",
                found,
                "noise",
                lambda m: m.name if m in unbiased else "",
                style="points",
                hollow=True,
            ),
        ]
        limit = max((2 * max(m.bias.error, m.bias.value) for m in unbiased if m.bias), default=0.0)
        if unbiased:
            caption = "Labels at the noise: the bias is not significant, "
            caption += f"at most {100 * limit:.2g} % of the mean value."
    else:
        names = dict.fromkeys(m.series for m in found)
        series = [_series(n, [m for m in found if m.series == n], style="joined") for n in names]
    return {
        "title": title,
        "text": text,
        "figure": _figure(series, "seconds per million queries", _NOISE_AXIS, png, caption),
        "table": _table(_GENERATOR, found).for_page(),
    }


def write_page(study: Study) -> Path:
    """Write CSV, page and plots into the study's folder; returns the path of the page."""
    write_text(study.folder / CSV_NAME, to_csv(study.measurements))
    sections = {}
    for kind in ("run", *_COMPARISONS):
        found = [m for m in study.measurements if m.study == kind]
        if found and kind == "run":
            sections["front"] = _front_section(found, study.folder / "front.png")
        elif found:
            sections[kind] = _generator_section(kind, found, study.folder / f"{kind}.png")
    html = render(
        "cost.html",
        study=study.description,
        time=clock(study.description["time"]),
        sections=sections,
        skipped=study.skipped,
        failed=study.failed,
        deviation=None if study.deviation is None else f"{study.deviation.scaled(100.0)} %",
        seeds=round(max((m.details.get("seeds", 0.0) for m in study.measurements), default=0.0)),
    )
    write_text(study.folder / PAGE_NAME, html)
    return study.folder / PAGE_NAME

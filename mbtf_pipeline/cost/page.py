"""The page of a study ``cost.html``, its plots as PNG, and ``cost.csv``."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

from mbtf_core.files.editable import write_document
from mbtf_core.stats import is_significant
from mbtf_core.units import clock
from mbtf_pipeline.cost.measurement import Measurement, pareto_front
from mbtf_pipeline.cost.study import Study
from mbtf_pipeline.report.plots import Series, plot
from mbtf_pipeline.report.report import render
from mbtf_pipeline.tables import Column, Table, rows_of

CSV_NAME, PAGE_NAME = "cost.csv", "cost.html"
_NOISE_AXIS = "RMS error relative to the mean value"
# The comparisons of the generator, in the order of the page.
_COMPARISONS = ("paths", "effects", "mesh", "interactions")


def _field(title: str, name: str, **options: Any) -> Column:
    return Column(title, name, attrgetter(name), **options)


def _detail(title: str, name: str, **options: Any) -> Column:
    return Column(title, name, lambda m: m.details.get(name), **options)


_COMMAND = _field("command", "command")
_PARTS = [_field(f"{name}, %", name, factor=100.0) for name in ("bias", "noise", "error")]
_SECONDS = _field("seconds per million queries", "seconds")
_SPENT = [
    _detail("total, s", "total_seconds", digits=".1f"),
    _detail("generating, s", "generation_seconds", digits=".1f"),
    _detail("training, s", "training_seconds", digits=".1f"),
    _detail("steps", "training_steps", digits=".0f"),
]
_SIZES = [
    _detail("million queries", "queries", factor=1e-6, digits=".2f"),
    _detail("paths each", "spp", digits="g"),
    _detail("1080p, ms", "evaluation_ms_1080p", digits=".0f"),
    _detail("MB", "bytes", factor=1e-6, digits=".2f"),
    _detail("seeds", "seeds", digits="g"),
]
_REST = [_detail("", name) for name in ("overhead_seconds", "evaluating_seconds")]
_TITLE = Column("configuration", "", lambda m: ", ".join(filter(None, (m.series, m.name))))
_GENERATOR = [_TITLE, _SECONDS, *_PARTS, _COMMAND]
_RUNS = [*_SPENT[:1], _field("unexplained variance", "error"), *_SPENT[1:], *_SIZES, _COMMAND]
_NAMES = [_field("", name) for name in ("study", "series", "name")]
_CSV = [*_NAMES, _SECONDS, *reversed(_PARTS), *_SPENT, *_REST, *_SIZES, _COMMAND]


def _table(columns: Sequence[Column], found: Sequence[Measurement]) -> Table:
    return Table("cost", "", columns, rows_of(columns, ([m] for m in found)))


def to_csv(found: Sequence[Measurement]) -> str:
    """One row per configuration; ``_se`` are standard errors, empty cells were not measured."""
    return _table(_CSV, found).csv()


def _series(
    name: str,
    found: Sequence[Measurement],
    part: str = "error",
    label: Callable[[Measurement], str] = lambda m: "",
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
    if max(len(one.x) for one in shown) < 2:
        return {"svg": "", "caption": ""}
    return {"svg": plot(shown, x, y, f"cost {png.stem}", png=png, **options), "caption": caption}


def _front_section(runs: Sequence[Measurement], png: Path) -> dict[str, Any]:
    """All runs and their Pareto front; of a single run its numbers."""
    front = pareto_front(runs)
    table = _table(_RUNS, front).for_page()
    if len(runs) < 2 and front:
        png.unlink(missing_ok=True)
        figure = {"svg": "", "caption": "One complete run was measured; a plot and a Pareto front take two."}
        return {"figure": figure, "table": table}
    axes = "seconds in total, from height map to material", "unexplained variance of test queries"
    series = _series("complete runs", runs, style="points", x_error_name="their time over seeds")
    stepped = [(m.seconds.value, m.error.value) for m in front] if len(front) > 1 else []
    figure = _figure([series], *axes, png, front=stepped)
    return {"figure": figure, "table": table}


def _generator_section(found: Sequence[Measurement], png: Path) -> dict[str, Any]:
    """Error over time of one comparison of the generator, split into bias and noise where there is a bias."""
    found = sorted(found, key=lambda m: (m.series, m.seconds.value))
    biased = [m for m in found if m.bias and is_significant(m.bias)]
    unbiased = [m for m in found if m.bias and m not in biased]
    caption = "Numbers are those of the table below."

    def number(m: Measurement) -> str:
        return str(found.index(m) + 1)

    if biased or unbiased:
        series = [_series("bias", biased, "bias", number, style="points")]
        series.append(_series("noise", found, "noise", number, style="points", hollow=True))
    else:
        names = dict.fromkeys(m.series for m in found)
        lines = ((name, [m for m in found if m.series == name]) for name in names)
        series = [_series(*line, label=number, style="joined") for line in lines]
    if unbiased:
        limit = 100 * max(2 * max(m.bias.error, m.bias.value) for m in unbiased if m.bias)
        most = f"at most {limit:.2g}%" if limit < 100 else "though it may exceed 100%"
        caption += f" A bias that is not shown is not significant, {most} of the mean value."
    return {
        "figure": _figure(series, "seconds per million queries", _NOISE_AXIS, png, caption),
        "table": _table([Column("number", "", number), *_GENERATOR], found).for_page(),
    }


def write_page(study: Study) -> Path:
    """Write CSV, page and plots into the study's folder; returns the path of the page."""
    write_document(study.folder / CSV_NAME, to_csv(study.measurements))
    sections = {}
    for kind in ("run", *_COMPARISONS):
        found = [m for m in study.measurements if m.study == kind]
        if found and kind == "run":
            sections["front"] = _front_section(found, study.folder / "front.png")
        elif len(found) > 1:
            sections[kind] = _generator_section(found, study.folder / f"{kind}.png")
    html = render(
        "cost.html",
        study=study.description,
        planned=clock(study.description["time"]),
        taken=clock(study.description["taken"]),
        sections=sections,
        more=study.more,
        skipped=study.skipped,
        failed=study.failed,
        deviation=f"{study.deviation.scaled(100.0)}%",
        test=statistics.median([100 * m.details["test_error"] for m in study.runs] or [0.0]),
    )
    write_document(study.folder / PAGE_NAME, html)
    return study.folder / PAGE_NAME

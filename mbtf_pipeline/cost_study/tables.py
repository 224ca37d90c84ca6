"""The points of a study as CSV, and as rows of the page's tables."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import Any

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost_study.measurements import Point

_DETAILS = (
    "queries",
    "spp",
    "generation_seconds",
    "training_seconds",
    "total_seconds",
    "evaluation_ms_1080p",
    "bytes",
    "half_bytes",
    "half_error",
    "relative",
    "relative_se",
    "paths",
    "seeds",
)
COLUMNS = (
    "study",
    "series",
    "name",
    "seconds",
    "seconds_se",
    "error",
    "error_se",
    "bias",
    "bias_se",
    "noise",
    "noise_se",
    *_DETAILS,
    "command",
)


def _number(x: float | None) -> str:
    return "" if x is None or not math.isfinite(x) else f"{x:.6g}"


def _pair(e: Estimate | None) -> tuple[str, str]:
    return ("", "") if e is None else (_number(e.value), _number(e.error))


def to_csv(points: Sequence[Point]) -> str:
    """One row per point; ``_se`` are standard errors, empty cells what was not measured."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for p in points:
        estimates = [cell for e in (p.seconds, p.error, p.bias, p.noise) for cell in _pair(e)]
        details = [_number(p.details.get(name)) for name in _DETAILS]
        writer.writerow([p.study, p.series, p.name, *estimates, *details, p.command])
    return stream.getvalue()


def _percent(e: Estimate | None) -> str:
    if e is None or not math.isfinite(e.value):
        return "–"
    if e.value == e.error == 0:
        return "0 %"
    if e.value <= 2 * e.error:
        return f"< {100 * 2 * max(e.error, e.value):.2g} %"
    return f"{e.scaled(100.0)} %"


def _seconds(e: Estimate) -> str:
    return f"{e}" if e.error > 0 else f"{e.value:.3g}"


def _told(e: Estimate) -> str:
    return f"{e}" if math.isfinite(e.value) else "–"


def generator_table(points: Sequence[Point]) -> dict[str, Any]:
    """Settings of the generator: price, bias, noise, both; for ways to count paths how many there were and
    the noise relative to each value in place of bias and total."""
    counts = any("relative" in p.details for p in points)
    head = ["setting", "seconds per million queries"]
    counted = ["paths per query", "noise", "noise ÷ max(value, tile mean)"]
    head += counted if counts else ["bias", "noise", "error"]
    rows = []
    for p in points:
        row = [f"{p.series}, {p.name}" if counts else p.name, _seconds(p.seconds)]
        if counts:
            d = p.details
            relative = Estimate(d["relative"], d["relative_se"], 1)
            row += [f"{d['paths']:.0f}", _percent(p.noise), _percent(relative)]
        else:
            row += [_percent(p.bias), _percent(p.noise), _percent(p.error)]
        rows.append([*row, p.command])
    return {"title": "", "head": [*head, "command"], "rows": rows}


def chain_table(points: Sequence[Point]) -> dict[str, Any]:
    """Whole chains: what was spent where, and what is left unexplained."""
    head = [
        "chain",
        "queries × paths",
        "generating, s",
        "training, s",
        "in all, s",
        "unexplained variance",
        "seeds",
        "the same in half precision",
        "1080p, ms",
        "MB",
        "MB in half",
        "command",
    ]
    rows = []
    for p in points:
        d = p.details
        rows.append(
            [
                f"{p.series}, {p.name}",
                f"{d['queries'] / 1e6:.2f} M × {d['spp']:g}",
                f"{d['generation_seconds']:.1f}",
                f"{d['training_seconds']:.1f}",
                f"{d['total_seconds']:.1f}",
                _told(p.error),
                f"{d.get('seeds', 1):g}",
                f"{d['half_error']:.4g}" if math.isfinite(d["half_error"]) else "–",
                f"{d['evaluation_ms_1080p']:.0f}",
                f"{d['bytes'] / 1e6:.2f}",
                f"{d['half_bytes'] / 1e6:.2f}",
                p.command,
            ]
        )
    return {"title": "", "head": head, "rows": rows}

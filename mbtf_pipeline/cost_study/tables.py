"""The measurements of a study as CSV and as tables of its page."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import Any

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost_study.figures import is_significant
from mbtf_pipeline.cost_study.measurements import Measurement

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
_ESTIMATES = ("seconds", "error", "bias", "noise")
COLUMNS = (
    "study",
    "series",
    "name",
    *(f"{name}{suffix}" for name in _ESTIMATES for suffix in ("", "_se")),
    *_DETAILS,
    "command",
)


def to_csv(found: Sequence[Measurement]) -> str:
    """One row per configuration; ``_se`` are standard errors, empty cells were not measured."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for m in found:
        numbers: list[float | None] = []
        for name in _ESTIMATES:
            e: Estimate | None = getattr(m, name)
            numbers += [None, None] if e is None else [e.value, e.error]
        numbers += [m.details.get(name) for name in _DETAILS]
        cells = ["" if x is None or not math.isfinite(x) else f"{x:.6g}" for x in numbers]
        writer.writerow([m.study, m.series, m.name, *cells, m.command])
    return stream.getvalue()


def _percent(e: Estimate | None) -> str:
    if e is None or not math.isfinite(e.value):
        return "–"
    if e.value == e.error == 0:
        return "0 %"
    return f"{e.scaled(100.0)} %" if is_significant(e) else f"< {100 * 2 * max(e.error, e.value):.2g} %"


def generator_table(found: Sequence[Measurement]) -> dict[str, Any]:
    """Configurations of the generator: time, bias, noise, and both together."""
    several = len({m.series for m in found}) > 1
    rows = [
        [
            f"{m.series}, {m.name}" if several else m.name,
            f"{m.seconds}",
            _percent(m.bias),
            _percent(m.noise),
            _percent(m.error),
            m.command,
        ]
        for m in found
    ]
    head = ["configuration", "seconds per million queries", "bias", "noise", "error", "command"]
    return {"title": "", "head": head, "rows": rows}


def run_table(found: Sequence[Measurement]) -> dict[str, Any]:
    """Runs: where the time went, and the error."""
    head = [
        "run",
        "queries × paths",
        "generating, s",
        "training, s",
        "total, s",
        "unexplained variance",
        "seeds",
        "1080p, ms",
        "MB",
        "command",
    ]
    rows = []
    for m in found:
        d = m.details
        rows.append(
            [
                f"{m.series}, {m.name}",
                f"{d['queries'] / 1e6:.2f} M × {d['spp']:g}",
                f"{d['generation_seconds']:.1f}",
                f"{d['training_seconds']:.1f}",
                f"{d['total_seconds']:.1f}",
                f"{m.error}" if math.isfinite(m.error.value) else "–",
                f"{d['seeds']:g}",
                f"{d['evaluation_ms_1080p']:.0f}",
                f"{d['bytes'] / 1e6:.2f}",
                m.command,
            ]
        )
    return {"title": "", "head": head, "rows": rows}

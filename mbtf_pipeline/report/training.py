"""Training curves of the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mbtf_pipeline.fit_records import TrainingHistory
from mbtf_pipeline.report.plots import Line, curves


def training_context(histories: Mapping[str, TrainingHistory]) -> dict[str, Any]:
    """Template data about training; one history per fit."""
    loss = [Line(name, *_columns(h.loss)) for name, h in histories.items() if h.loss]
    errors = [Line(name, *_columns(h.unexplained)) for name, h in histories.items() if h.unexplained]
    plots = []
    if loss:
        svg = curves(loss, "seconds of training", "training loss", "training loss over seconds")
        plots.append({"title": "Training loss, including noise", "svg": svg})
    if errors:
        svg = curves(errors, "seconds of training", "unexplained variance", "error over seconds")
        plots.append({"title": "Validation error, noise-free", "svg": svg})
    lines = [
        f"{name}: {h.steps:,} steps of {h.batch:,} queries in {h.seconds:.0f} s on {h.device}, {h.threads} "
        f"threads ({h.samples_per_second / 1e6:.2f} M queries/s)"
        for name, h in histories.items()
    ]
    return {"training_plots": plots, "training_lines": lines}


def _columns(rows: list[Any]) -> list[list[float]]:
    return [list(column) for column in zip(*rows, strict=True)]

"""Training of the report: history of every fit, and its curves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_pipeline.report.plots import Line, curves


@dataclass(frozen=True)
class TrainingHistory:
    """Loss and error over training time.

    Attributes
    ----------
    training : of the material's description: steps, batch, seconds, device and threads
    records : one per validation, from ``mbtf_fit.read_history``
    """

    training: Mapping[str, Any]
    records: list[dict[str, Any]]

    @property
    def samples(self) -> int:
        """Number of training queries, counting repetitions."""
        return int(self.training["steps"] * self.training["batch"])

    @property
    def rate(self) -> float:
        """Mean number of queries per second, in millions."""
        return self.samples / max(self.training["seconds"], 1e-9) / 1e6

    def columns(self, *keys: str) -> list[list[float]]:
        """Values of the records in which all of them are finite, by key."""
        rows = [[r.get(key) for key in keys] for r in self.records]
        finite = [row for row in rows if all(x is not None and math.isfinite(x) for x in row)]
        return [list(column) for column in zip(*finite, strict=True)]

    @property
    def unexplained(self) -> list[list[float]]:
        """Seconds, unexplained variance of the validation queries, and its standard error; or empty."""
        return self.columns("seconds", "unexplained", "unexplained_error")


def read_training(folder: Path) -> TrainingHistory:
    """History of the fit in a folder.

    Raises
    ------
    InputError : the folder contains no material
    """
    from mbtf_fit import Material, read_history

    return TrainingHistory(Material.load(folder).description["training"], read_history(folder))


def training_context(histories: Mapping[str, TrainingHistory]) -> dict[str, Any]:
    """Template data about training; one history per fit."""
    loss = [Line(name, *c) for name, h in histories.items() if (c := h.columns("seconds", "loss"))]
    errors = [Line(name, *c) for name, h in histories.items() if (c := h.unexplained)]
    plots = []
    if loss:
        svg = curves(loss, "seconds of training", "training loss", "training loss over seconds")
        plots.append({"title": "Training loss, including noise", "svg": svg})
    if errors:
        svg = curves(errors, "seconds of training", "unexplained variance", "error over seconds")
        plots.append({"title": "Validation error, noise-free", "svg": svg})
    lines = [
        "{}: {steps:,} steps of {batch:,} queries in {seconds:.0f} s on {device}, {threads} threads "
        "({:.2f} M queries/s)".format(name, h.rate, **h.training)
        for name, h in histories.items()
    ]
    return {"training_plots": plots, "training_lines": lines}

"""Training and times of the report: curves of every fit, seconds per stage, software versions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_pipeline.report.plots import Line, bars, curves
from mbtf_pipeline.run_folder import FITS
from mbtf_pipeline.stages import read_stamp


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
    def rate(self) -> float:
        """Mean number of queries per second, in millions."""
        samples = self.training["steps"] * self.training["batch"]
        return float(samples / max(self.training["seconds"], 1e-9) / 1e6)

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


def time_context(
    folder: Path,
    stages: Sequence[str],
    manifest: Mapping[str, Any],
    comparison: Mapping[str, Any],
) -> dict[str, Any]:
    """Template data about time.

    Parameters
    ----------
    folder : of the run
    stages : names of finished stages
    """
    stamps = {name: read_stamp(folder, name) for name in stages}
    seconds = [(name, stamp.seconds) for name, stamp in stamps.items() if stamp is not None]
    total = sum(s for _, s in seconds)
    svg = bars(seconds, "seconds", "seconds per stage")
    plots = [{"title": f"Seconds per stage, {total:.0f} in total", "svg": svg}]
    return {"time_plots": plots, "time_tables": [_generation(manifest), _comparison(comparison)]}


def _generation(manifest: Mapping[str, Any]) -> dict[str, Any]:
    summary, train = manifest["summary"], manifest["splits"]["train"]
    seconds, paths = float(summary["shard_seconds"]), int(summary["paths"])
    noise = float(summary["relative_error"])
    row = {
        "seconds": f"{seconds:.1f}",
        "paths": f"{paths:,}",
        "M paths/s": f"{paths / max(seconds, 1e-9) / 1e6:.2f}",
        "training queries": f"{train['queries']:,}",
        "paths per query": f"{train['spp']:g}",
        "noise of a training query": f"{noise:.0%} of the mean value",
        "noise of the mean over queries": f"{noise / np.sqrt(train['queries']):.2%}",
    }
    return {"title": "Generate", "head": list(row), "rows": [list(row.values())]}


def _comparison(comparison: Mapping[str, Any]) -> dict[str, Any]:
    """Seconds of an image: references by the whole stage, fits by their median."""
    count = len(comparison["pictures"])
    rows = [["references", f"{comparison['seconds']['references'] / count:.1f}"]]
    for fit in comparison["fits"]:
        times = [p["fits"][fit]["seconds"] for p in comparison["pictures"]]
        # Robust against images that another process slowed down.
        rows.append([fit, f"{np.median(times):.3g}"])
    return {"title": "Compare", "head": ["", "seconds per image"], "rows": rows}


def provenance(
    folder: Path, manifest: Mapping[str, Any], fits: Mapping[str, Path], machine: Mapping[str, str]
) -> dict[str, Any]:
    """Digests of inputs and outputs, and software versions."""
    rows = [[f"material, {role}", digest] for role, digest in manifest["inputs"].items()]
    rows.append(["configuration of the data set", manifest["config_hash"]])
    for name in fits:
        stamp = read_stamp(folder, f"fit {name}")
        if stamp is not None:
            rows.append([f"{FITS}/{name}, all files", stamp.outputs_hash])
    rows += [[name, version] for name, version in machine.items()]
    return {"head": ["item", "SHA-256 or version"], "rows": rows}

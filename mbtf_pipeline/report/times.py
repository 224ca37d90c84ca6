"""Times of the report: seconds per stage, error over time, and software versions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.stats import Estimate
from mbtf_pipeline.formatting import estimate, estimate_text
from mbtf_pipeline.report.plots import Line, bars, curves
from mbtf_pipeline.report.training import TrainingHistory
from mbtf_pipeline.run_folder import FITS
from mbtf_pipeline.stages import read_stamp

# Fractions of the training time at which the error is listed.
_FRACTIONS = (0.1, 0.25, 0.5, 1.0)


def time_context(
    folder: Path,
    stages: Sequence[str],
    manifest: Mapping[str, Any],
    comparison: Mapping[str, Any],
    histories: Mapping[str, TrainingHistory],
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
    generation = float(manifest["summary"]["shard_seconds"])
    lines = [
        Line(name, [generation + seconds for seconds in found[0]], *found[1:])
        for name, h in histories.items()
        if (found := h.unexplained)
    ]
    if lines:
        axes = ("seconds of generation and training", "unexplained variance")
        svg = curves(lines, *axes, "error over total time", scales="xy")
        plots.append({"title": "Error over total time", "svg": svg})
    tables = [_generation(manifest), _fits(histories), _comparison(comparison)]
    return {"time_plots": plots, "time_tables": tables}


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


def _at(history: TrainingHistory, fraction: float) -> str:
    """Validation error nearest to a fraction of the training time."""
    if not history.unexplained:
        return "–"
    wanted = fraction * history.training["seconds"]
    rows = zip(*history.unexplained, strict=True)
    seconds, value, error = min(rows, key=lambda row: abs(row[0] - wanted))
    return f"{estimate_text(Estimate(value, error, 0))} at {seconds:.0f} s"


def _fits(histories: Mapping[str, TrainingHistory]) -> dict[str, Any]:
    return {
        "title": "Fit: unexplained variance over training time",
        "head": ["fit", "seconds", "queries", "rate", *(f"after {f:.0%}" for f in _FRACTIONS)],
        "rows": [
            [
                name,
                f"{h.training['seconds']:.1f}",
                f"{h.samples / 1e6:.1f} M",
                f"{h.rate:.2f} M/s",
                *(_at(h, fraction) for fraction in _FRACTIONS),
            ]
            for name, h in histories.items()
        ],
    }


def _comparison(comparison: Mapping[str, Any]) -> dict[str, Any]:
    pictures = comparison["pictures"]
    pixels = comparison["size"] ** 2
    seconds = comparison["seconds"]["references"]
    paths = pixels * comparison["spp"] * len(pictures) * len(comparison["kinds"])
    noise = [estimate(r["noise"]).value for p in pictures for r in p["references"].values()]
    rows = [
        [
            "references",
            f"{seconds:.1f}",
            f"{paths / max(seconds, 1e-9) / 1e6:.2f} M paths/s",
            f"noise per pixel {np.median(noise):.1%} of the mean",
        ]
    ]
    for fit in comparison["fits"]:
        times = [p["fits"][fit]["seconds"] for p in pictures]
        # Robust against images that another process slowed down.
        typical = float(np.median(times))
        rate = f"{pixels / max(typical, 1e-9) / 1e6:.2f} M queries/s"
        rows.append([fit, f"{sum(times):.2f}", rate, f"median {1e3 * typical:.0f} ms per image"])
    return {"title": "Compare", "head": ["", "seconds", "rate", ""], "rows": rows}


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

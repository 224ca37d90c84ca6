"""The report's times: seconds per stage and the error each second bought; inputs and versions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.stats import Estimate
from mbtf_pipeline.fit_records import History
from mbtf_pipeline.formatting import error_text, estimate
from mbtf_pipeline.report.plots import Curve, bars, curves
from mbtf_pipeline.run_folder import FITS
from mbtf_pipeline.stages import Stamp, read_stamp

# Shares of a fit's time at which its error is listed.
_SHARES = (0.1, 0.25, 0.5, 1.0)


def _stamps(folder: Path, names: Sequence[str]) -> dict[str, Stamp]:
    found = {name: read_stamp(folder, name) for name in names}
    return {name: stamp for name, stamp in found.items() if stamp is not None}


def time_context(
    folder: Path,
    stages: Sequence[str],
    manifest: Mapping[str, Any],
    comparison: Mapping[str, Any],
    histories: Mapping[str, History],
) -> dict[str, Any]:
    """What the template shows about time.

    Parameters
    ----------
    folder : of the run; stages : names of those that have run
    """
    stamps = _stamps(folder, stages)
    total = sum(stamp.seconds for stamp in stamps.values())
    plots = [
        {
            "title": f"Seconds per stage, {total:.0f} in all",
            "svg": bars([(n, s.seconds) for n, s in stamps.items()], "seconds", "seconds per stage"),
        }
    ]
    generation = float(manifest["summary"]["shard_seconds"])
    bought = [
        Curve(name, [generation + s for s, _, _ in h.unexplained], *_errors(h))
        for name, h in histories.items()
        if h.unexplained
    ]
    if bought:
        plots.append(
            {
                "title": "Error against everything spent so far",
                "svg": curves(
                    bought,
                    "seconds of generation and training",
                    "unexplained variance",
                    "error over all seconds",
                    logx=True,
                ),
            }
        )
    return {
        "time_plots": plots,
        "time_tables": [_generation(manifest), _fits(histories), _comparison(comparison)],
    }


def _generation(manifest: Mapping[str, Any]) -> dict[str, Any]:
    summary, splits = manifest["summary"], manifest["splits"]
    seconds, paths = float(summary["shard_seconds"]), int(summary["paths"])
    rate = paths / max(seconds, 1e-9)
    noise = float(summary["relative_error"])
    train = splits["train"]
    return {
        "title": "Generate",
        "head": [
            "seconds",
            "paths",
            "M paths/s",
            "training queries",
            "paths each",
            "noise of one training query",
            "noise of the mean of all",
        ],
        "rows": [
            [
                f"{seconds:.1f}",
                f"{paths:,}",
                f"{rate / 1e6:.2f}",
                f"{train['queries']:,}",
                f"{train['spp']:g}",
                f"{noise:.0%} of the mean value",
                f"{noise / np.sqrt(train['queries']):.2%}",
            ]
        ],
    }


def _errors(history: History) -> tuple[list[float], list[float]]:
    return [e for _, e, _ in history.unexplained], [error for _, _, error in history.unexplained]


def _at(history: History, share: float) -> str:
    """Error at a share of the time, and when it was looked at."""
    if not history.unexplained:
        return "–"
    seconds, value, error = min(history.unexplained, key=lambda r: abs(r[0] - share * history.seconds))
    return f"{error_text(_measured(value, error))} at {seconds:.0f} s"


def _measured(value: float, error: float) -> Estimate:
    """An estimate of which only the standard error is known."""
    return Estimate(value, error, 0)


def _bought(history: History) -> str:
    """Unexplained variance that ten seconds bought in the second half of training.

    The error bar takes the two looks as independent. They are at the same queries, so it is rather too wide.
    """
    later = [r for r in history.unexplained if r[0] >= 0.5 * history.seconds]
    if len(later) < 2 or later[-1][0] <= later[0][0]:
        return "–"
    (start, before, error_before), (end, after, error_after) = later[0], later[-1]
    bought = _measured(before - after, math.hypot(error_before, error_after))
    return error_text(bought.scaled(10 / (end - start)))


def _fits(histories: Mapping[str, History]) -> dict[str, Any]:
    rows = [
        [
            name,
            f"{h.seconds:.1f}",
            f"{h.samples / 1e6:.1f} M",
            f"{h.samples_per_second / 1e6:.2f} M/s",
            *(_at(h, share) for share in _SHARES),
            _bought(h),
        ]
        for name, h in histories.items()
    ]
    head = [f"after {share:.0%}" for share in _SHARES]
    return {
        "title": "Fit: unexplained variance after shares of its seconds",
        "head": ["fit", "seconds", "queries", "rate", *head, "bought per 10 s, second half"],
        "rows": rows,
    }


def _comparison(comparison: Mapping[str, Any]) -> dict[str, Any]:
    pixels = comparison["size"] ** 2
    pictures = comparison["pictures"]
    spent = comparison["seconds"]
    paths = pixels * comparison["spp"] * len(pictures) * len(comparison["kinds"])
    noise = [estimate(r["noise"]).value for p in pictures for r in p["references"].values()]
    rows = [
        [
            "references",
            f"{spent['references']:.1f}",
            f"{paths / max(spent['references'], 1e-9) / 1e6:.2f} M paths/s",
            f"noise of a pixel {np.median(noise):.1%} of the mean",
        ]
    ]
    for fit in comparison["fits"]:
        seconds = [p["fits"][fit]["seconds"] for p in pictures]
        # One picture that something else slowed down must not speak for all.
        typical = float(np.median(seconds))
        rows.append(
            [
                fit,
                f"{sum(seconds):.2f}",
                f"{pixels / max(typical, 1e-9) / 1e6:.2f} M queries/s",
                f"{1e3 * typical:.0f} ms per picture, median",
            ]
        )
    return {"title": "Compare: the same pictures", "head": ["", "seconds", "rate", ""], "rows": rows}


def provenance(
    folder: Path, manifest: Mapping[str, Any], fits: Mapping[str, Path], machine: Mapping[str, str]
) -> dict[str, Any]:
    """Inputs with digests, hashes of what was made, and versions."""
    rows = [[f"material, {role}", digest] for role, digest in manifest["inputs"].items()]
    rows.append(["data set, configuration", manifest["config_hash"]])
    for name in fits:
        stamp = read_stamp(folder, f"fit {name}")
        if stamp is not None:
            rows.append([f"{FITS}/{name}, all files", stamp.outputs_hash])
    rows += [[name, version] for name, version in machine.items()]
    return {"head": ["what", "SHA-256, or version"], "rows": rows}

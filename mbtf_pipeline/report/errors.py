"""Errors of the report: summary figures, the table of fits, errors by level and cosine, definitions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import median_high
from typing import Any

from mbtf_core.color import describe_exposure
from mbtf_fit.formatting import SPLIT_NAMES
from mbtf_pipeline.compare.perceptual_metrics import available_metrics
from mbtf_pipeline.number_text import data_errors, decibel, estimate, estimate_text, short_direction
from mbtf_pipeline.report.plots import points

UNEXPLAINED = "unexplained variance"
_TERMS = {
    "mse": "MSE",
    "psnr": "PSNR",
    "relative_mse": "relative MSE",
    "flip": "FLIP",
    "ssim": "SSIM",
    "st_lpips": "ST-LPIPS",
    "error_bar": "error bar",
}


def error_context(comparison: Mapping[str, Any], min_cos: float) -> dict[str, Any]:
    """Template data about errors.

    Parameters
    ----------
    min_cos : smallest cosine of light and view in the data
    """
    tests = {fit: record["splits"]["test"] for fit, record in comparison["test"].items()}
    return {
        "facts": _facts(comparison, tests),
        "test": next(iter(tests.values())),
        "error_table": _table(comparison),
        "error_plots": [_plot(tests, min_cos, *grouping[:3]) for grouping in _GROUPINGS],
        "group_tables": [_group_table(tests, min_cos, *grouping) for grouping in _GROUPINGS],
        "picture_table": _pictures_table(comparison),
        "definitions": [(_TERMS[k], v) for k, v in comparison["definitions"].items()],
    }


def _facts(comparison: Mapping[str, Any], tests: Mapping[str, Any]) -> list[dict[str, str]]:
    out = [{"value": data_errors(e)[0], "what": f"{UNEXPLAINED} of {fit}"} for fit, e in tests.items()]
    fit = comparison["fits"][0]
    records = [p["fits"][fit] for p in comparison["pictures"]]
    decibels = [r["errors"][comparison["kinds"][0]]["psnr"]["value"] for r in records]
    if finite := [d for d in decibels if d is not None]:
        what = f"median PSNR of {fit} over {len(decibels)} images"
        out.append({"value": f"{median_high(finite):.1f} dB", "what": what})
    flip = median_high(r["flip"]["hdr"] for r in records)
    out.append({"value": f"{flip:.3f}", "what": f"median HDR-FLIP of {fit} (0 is best)"})
    record = comparison["test"][fit]
    size = 4 * (record["network_weights"] + record["texels"]) / 1024
    out.append({"value": f"{size:,.0f} KiB", "what": f"{fit}: textures and networks as float32"})
    return out


def _table(comparison: Mapping[str, Any]) -> dict[str, Any]:
    splits = list(next(iter(comparison["test"].values()))["splits"])
    head = [
        "fit",
        *(f"{UNEXPLAINED}, {SPLIT_NAMES[s]}" for s in splits),
        "MSE, test [10⁻³/sr²]",
        "network weights",
        "texture values",
    ]
    rows = []
    for fit, record in comparison["test"].items():
        cells = [data_errors(record["splits"][s])[0] if s in record["splits"] else "–" for s in splits]
        mse = data_errors(record["splits"]["test"])[1]
        rows.append([fit, *cells, mse, f"{record['network_weights']:,}", f"{record['texels']:,}"])
    return {"head": head, "rows": rows}


# Ways to group queries: key in the record, title, axis of the plot, and head of the table.
_GROUPINGS = (
    ("levels", "By level of detail (level 0: the whole tile)", "level of the footprint", "level"),
    ("elevations", "By lower cosine of light and view", "lower cosine of light and view", "cos θ"),
)


def group_label(name: str, min_cos: float) -> str:
    """``4`` for a level, ``0.3–0.4`` for a range of cosines, which is cut at the smallest in the data."""
    low, _, high = name.partition("-")
    if not high:
        return name
    return f"{min_cos:g}–{high}" if float(low) < min_cos < float(high) else f"{low}–{high}"


def _group_names(tests: Mapping[str, Any], key: str) -> list[str]:
    return sorted({n for test in tests.values() for n in test[key]}, key=lambda n: float(n.split("-")[0]))


def _plot(tests: Mapping[str, Any], min_cos: float, key: str, title: str, axis: str) -> dict[str, str]:
    names = _group_names(tests, key)
    series = {fit: [_value(test[key].get(n)) for n in names] for fit, test in tests.items()}
    labels = [group_label(name, min_cos) for name in names]
    svg = points(labels, series, axis, UNEXPLAINED, f"{UNEXPLAINED} {title}")
    return {"title": title, "svg": svg}


def _value(group: Mapping[str, Any] | None) -> tuple[float, float] | None:
    if group is None:
        return None
    e = estimate(group["unexplained"])
    return (e.value, e.error) if math.isfinite(e.value) and math.isfinite(e.error) else None


def _group_table(
    tests: Mapping[str, Any], min_cos: float, key: str, title: str, axis: str, head: str
) -> dict[str, Any]:
    rows = []
    for name in _group_names(tests, key):
        groups = [test[key].get(name) for test in tests.values()]
        first = next(group for group in groups if group is not None)
        cells = [cell for group in groups for cell in (("–", "–") if group is None else data_errors(group))]
        rows.append([group_label(name, min_cos), f"{first['mse']['n']:,}", *cells])
    heads = [h for fit in tests for h in (f"{fit}: {UNEXPLAINED}", f"{fit}: MSE [10⁻³/sr²]")]
    return {"title": f"{title}, test split", "head": [head, "queries", *heads], "rows": rows}


def _pictures_table(comparison: Mapping[str, Any]) -> dict[str, Any]:
    """Errors of every image against each kind of reference; one row per image and fit."""
    kinds = comparison["kinds"]
    metrics = available_metrics(comparison["pictures"], comparison["fits"])
    rows = []
    for picture in comparison["pictures"]:
        where = [*(short_direction(picture[d]) for d in ("view", "light")), f"{picture['tiles_across']:g}"]
        noise = picture["references"][kinds[0]]
        for fit in comparison["fits"]:
            record = picture["fits"][fit]
            row = [*where, fit]
            for kind in kinds:
                errors = {name: estimate(e) for name, e in record["errors"][kind].items()}
                row += [estimate_text(errors["mse"], 1e3), decibel(errors["psnr"], errors["mse"])]
                row.append(estimate_text(errors["relative_mse"]))
            rows.append(row + [m.text(m.of(record), m.of(noise)) for m in metrics])
    names = ("MSE [10⁻³/sr²]", "PSNR", "relative MSE")
    heads = [f"{name}, {kind} reference" for kind in kinds for name in names]
    title = f"Images at {describe_exposure(comparison['exposure'])}; white is the peak of the PSNR"
    head = ["view", "light", "tiles across", "fit", *heads, *(m.title for m in metrics)]
    return {"title": title, "head": head, "rows": rows}

"""The report's errors: facts on top, the table of fits, errors by level and elevation, definitions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from .plots import points
from .report_pictures import decibel, estimate, percent

UNEXPLAINED = "unexplained variance"
_TERMS = {"mse": "MSE", "psnr": "PSNR", "relative_mse": "relative MSE", "error_bar": "error bar"}


def _first_split(comparison: Mapping[str, Any]) -> dict[str, Any]:
    return {fit: record["splits"]["test"] for fit, record in comparison["test"].items()}


def error_context(comparison: Mapping[str, Any]) -> dict[str, Any]:
    """What the template shows about errors."""
    return {
        "facts": _facts(comparison),
        "test": next(iter(_first_split(comparison).values())),
        "error_table": _table(comparison),
        "error_plots": _plots(comparison),
        "detail_tables": [
            _groups_table(comparison, "levels", "By level of detail", "level"),
            _groups_table(comparison, "elevations", "By the smaller cosine of light and view", "cos θ"),
            _pictures_table(comparison),
        ],
        "definitions": [(_TERMS[k], v) for k, v in comparison["definitions"].items()],
    }


def _facts(comparison: Mapping[str, Any]) -> list[dict[str, str]]:
    out = []
    for fit, split in _first_split(comparison).items():
        e = estimate(split["unexplained"])
        value = f"{100 * e.value:.1f} %" if math.isfinite(e.value) else "–"
        out.append({"value": value, "what": f"of the test values' variance unexplained by {fit}"})
    fit = comparison["fits"][0]
    main = "query" if "query" in comparison["kinds"] else comparison["kinds"][0]
    decibels = [p["fits"][fit]["errors"][main]["psnr"]["value"] for p in comparison["pictures"]]
    finite = sorted(d for d in decibels if d is not None)
    if finite:
        middle = finite[len(finite) // 2]
        out.append(
            {"value": f"{middle:.1f} dB", "what": f"median PSNR of {fit} over {len(decibels)} pictures"}
        )
    record = comparison["test"][fit]
    size = 4 * (record["network_weights"] + record["texels"]) / 1024
    out.append({"value": f"{size:,.0f} KiB", "what": f"{fit}: textures and network as float32"})
    return out


def _table(comparison: Mapping[str, Any]) -> dict[str, Any]:
    splits = list(next(iter(comparison["test"].values()))["splits"])
    head = [
        "fit",
        *(f"{UNEXPLAINED}, {s}" for s in splits),
        "MSE, test [10⁻³/sr²]",
        "network weights",
        "texture values",
    ]
    rows = []
    for fit, record in comparison["test"].items():
        cells = [
            percent(estimate(record["splits"][s]["unexplained"])) if s in record["splits"] else "–"
            for s in splits
        ]
        mse = estimate(record["splits"]["test"]["mse"]).scaled(1e3)
        rows.append([fit, *cells, str(mse), f"{record['network_weights']:,}", f"{record['texels']:,}"])
    return {"head": head, "rows": rows}


def _plots(comparison: Mapping[str, Any]) -> list[dict[str, str]]:
    out = []
    splits = _first_split(comparison)
    for key, title, axis in (
        ("levels", "By level of detail (0 is the whole tile)", "level of the footprint"),
        ("elevations", "By grazing angle", "smaller cosine of light and view"),
    ):
        names = _group_names(splits, key)
        series = {
            fit: [_value(split[key].get(n, {}).get("unexplained")) for n in names]
            for fit, split in splits.items()
        }
        labels = [name.replace("-", "–") for name in names]
        svg = points(labels, series, axis, UNEXPLAINED, f"{UNEXPLAINED} {title}")
        out.append({"title": title, "svg": svg})
    return out


def _group_names(splits: Mapping[str, Any], key: str) -> list[str]:
    return sorted({n for split in splits.values() for n in split[key]}, key=lambda n: float(n.split("-")[0]))


def _value(record: Mapping[str, Any] | None) -> tuple[float, float] | None:
    if record is None or record["value"] is None or record["error"] is None:
        return None
    return float(record["value"]), float(record["error"])


def _groups_table(comparison: Mapping[str, Any], key: str, title: str, head: str) -> dict[str, Any]:
    splits = _first_split(comparison)
    names = _group_names(splits, key)
    rows = []
    for name in names:
        first = next(s for s in splits.values() if name in s[key])[key][name]
        cells = []
        for split in splits.values():
            group = split[key].get(name)
            cells += (
                ["–", "–"]
                if group is None
                else [percent(estimate(group["unexplained"])), str(estimate(group["mse"]).scaled(1e3))]
            )
        rows.append([name.replace("-", "–"), f"{first['mse']['n']:,}", *cells])
    heads = [h for fit in splits for h in (f"{fit}: unexplained", f"{fit}: MSE [10⁻³/sr²]")]
    return {"title": title, "head": [head, "queries", *heads], "rows": rows}


def _pictures_table(comparison: Mapping[str, Any]) -> dict[str, Any]:
    """One row per picture and fit, errors against each kind of reference."""
    kinds = comparison["kinds"]
    rows = []
    for picture in comparison["pictures"]:
        view, light = (
            f"{picture[d]['elevation']:g}°, {picture[d]['azimuth']:g}°".replace("-", "−")
            for d in ("view", "light")
        )
        for fit in comparison["fits"]:
            row = [view, light, f"{picture['span']:g}", fit]
            for kind in kinds:
                errors = picture["fits"][fit]["errors"][kind]
                row += [
                    str(estimate(errors["mse"]).scaled(1e3)),
                    decibel(errors["psnr"]).removeprefix("PSNR "),
                    str(estimate(errors["relative_mse"])),
                ]
            rows.append(row)
    measures = ("MSE [10⁻³/sr²]", "PSNR", "relative MSE")
    heads = [f"{m}, {kind} reference" for kind in kinds for m in measures]
    title = f"Pictures (PSNR's peak: {comparison['white']:.3g} 1/sr)"
    return {"title": title, "head": ["view", "light", "tiles across", "fit", *heads], "rows": rows}

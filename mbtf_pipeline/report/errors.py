"""The report's errors: facts on top, the table of fits, errors by level and elevation, definitions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mbtf_fit.formatting import SPLIT_NAMES
from mbtf_pipeline.compare.perceptual_metrics import measured, visible_text
from mbtf_pipeline.formatting import data_errors, decibel, error_text, estimate, short_direction
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


def _first_split(comparison: Mapping[str, Any]) -> dict[str, Any]:
    return {fit: record["splits"]["test"] for fit, record in comparison["test"].items()}


def error_context(comparison: Mapping[str, Any], min_cos: float) -> dict[str, Any]:
    """What the template shows about errors.

    Parameters
    ----------
    min_cos : smallest cosine of light and view in the data
    """
    return {
        "facts": _facts(comparison),
        "test": next(iter(_first_split(comparison).values())),
        "error_table": _table(comparison),
        "error_plots": _plots(comparison, min_cos),
        "group_tables": [_groups_table(comparison, grouping, min_cos) for grouping in _GROUPINGS],
        "picture_table": _pictures_table(comparison),
        "definitions": [(_TERMS[k], v) for k, v in comparison["definitions"].items()],
    }


def _facts(comparison: Mapping[str, Any]) -> list[dict[str, str]]:
    out = []
    for fit, split in _first_split(comparison).items():
        value, _ = data_errors(split)
        out.append({"value": value, "what": f"of the test values' variance unexplained by {fit}"})
    fit = comparison["fits"][0]
    decibels = [
        p["fits"][fit]["errors"][main_kind(comparison)]["psnr"]["value"] for p in comparison["pictures"]
    ]
    finite = sorted(d for d in decibels if d is not None)
    if finite:
        middle = finite[len(finite) // 2]
        out.append(
            {"value": f"{middle:.1f} dB", "what": f"median PSNR of {fit} over {len(decibels)} pictures"}
        )
    visible = sorted(p["fits"][fit]["flip"]["hdr"] for p in comparison["pictures"])
    out.append({"value": f"{visible[len(visible) // 2]:.3f}", "what": f"median HDR-FLIP of {fit}, 0 is none"})
    record = comparison["test"][fit]
    size = 4 * (record["network_weights"] + record["texels"]) / 1024
    out.append({"value": f"{size:,.0f} KiB", "what": f"{fit}: textures and network as float32"})
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


@dataclass(frozen=True)
class _Grouping:
    """A way to group queries: its key in the record, titles, and the name of a group."""

    key: str
    title: str
    axis: str
    head: str


_GROUPINGS = (
    _Grouping("levels", "By level of detail (0 is the whole tile)", "level of the footprint", "level"),
    _Grouping("elevations", "By lowest cosine of light and view", "lower cosine of light and view", "cos θ"),
)


def group_label(name: str, min_cos: float) -> str:
    """``4`` of a level, ``0.3–0.4`` of a band of cosines, which begins no lower than the data do."""
    low, _, high = name.partition("-")
    if not high:
        return name
    return f"{min_cos:g}–{high}" if float(low) < min_cos < float(high) else f"{low}–{high}"


def _plots(comparison: Mapping[str, Any], min_cos: float) -> list[dict[str, str]]:
    out = []
    splits = _first_split(comparison)
    for grouping in _GROUPINGS:
        names = _group_names(splits, grouping.key)
        series = {
            fit: [_value(split[grouping.key].get(n, {}).get("unexplained")) for n in names]
            for fit, split in splits.items()
        }
        labels = [group_label(name, min_cos) for name in names]
        svg = points(labels, series, grouping.axis, UNEXPLAINED, f"{UNEXPLAINED} {grouping.title}")
        out.append({"title": grouping.title, "svg": svg})
    return out


def _group_names(splits: Mapping[str, Any], key: str) -> list[str]:
    return sorted({n for split in splits.values() for n in split[key]}, key=lambda n: float(n.split("-")[0]))


def _value(record: Mapping[str, Any] | None) -> tuple[float, float] | None:
    if record is None or record["value"] is None or record["error"] is None:
        return None
    return float(record["value"]), float(record["error"])


def _groups_table(comparison: Mapping[str, Any], grouping: _Grouping, min_cos: float) -> dict[str, Any]:
    key = grouping.key
    splits = _first_split(comparison)
    names = _group_names(splits, key)
    rows = []
    for name in names:
        first = next(s for s in splits.values() if name in s[key])[key][name]
        cells: list[str] = []
        for split in splits.values():
            group = split[key].get(name)
            cells += ("–", "–") if group is None else data_errors(group)
        rows.append([group_label(name, min_cos), f"{first['mse']['n']:,}", *cells])
    heads = [h for fit in splits for h in (f"{fit}: unexplained", f"{fit}: MSE [10⁻³/sr²]")]
    return {
        "title": f"{grouping.title}, test split",
        "head": [grouping.head, "queries", *heads],
        "rows": rows,
    }


def _pictures_table(comparison: Mapping[str, Any]) -> dict[str, Any]:
    """One row per picture and fit, errors against each kind of reference."""
    kinds = comparison["kinds"]
    main = main_kind(comparison)
    visible = measured(comparison["pictures"], comparison["fits"])
    rows = []
    for picture in comparison["pictures"]:
        for fit in comparison["fits"]:
            row = [short_direction(picture[d]) for d in ("view", "light")]
            row += [f"{picture['tiles_across']:g}", fit]
            made = picture["fits"][fit]
            for kind in kinds:
                errors = made["errors"][kind]
                row += [
                    error_text(estimate(errors["mse"]), 1e3),
                    decibel(errors["psnr"], errors["mse"]),
                    error_text(estimate(errors["relative_mse"])),
                ]
            row += [visible_text(m, made, picture["references"][main]) for m in visible]
            rows.append(row)
    measures = ("MSE [10⁻³/sr²]", "PSNR", "relative MSE")
    heads = [f"{m}, {kind} reference" for kind in kinds for m in measures]
    heads += [m.title for m in visible]
    title = f"Pictures (PSNR’s peak and 0 EV: {comparison['white']:.3g} 1/sr is white)"
    return {"title": title, "head": ["view", "light", "tiles across", "fit", *heads], "rows": rows}


def main_kind(comparison: Mapping[str, Any]) -> str:
    """The kind of reference that FLIP and the maps are against."""
    kinds = comparison["kinds"]
    return "query" if "query" in kinds else str(kinds[0])

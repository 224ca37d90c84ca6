"""What the commands print of fits and of their errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mbtf_core.app.console import format_table
from mbtf_core.stats import SIGNIFICANT
from mbtf_core.units import clock
from mbtf_fit.formatting import (
    SPLIT_NAMES,
    above_one,
    format_estimate,
    headline,
    outliers,
    unreliable,
    visibility,
)

# Colors that make this share of the variance are missed where so much of them is unexplained.
_COLORED, _UNLEARNED = 0.02, 0.5


def describe_fit(data: Mapping[str, Any], verbose: bool = False) -> str:
    """Model, steps and time of a fit, and its errors."""
    training = data["training"]
    rate = training["steps"] * training["batch"] / max(training["seconds"], 1e-9)
    first = (
        f"{data['material']}: {data['model']}, {training['steps']} steps of {training['batch']} queries in "
        f"{clock(training['seconds'])} on {training['device']} with {training['backend']} "
        f"({rate / 1e6:.2f} M queries/s)"
    )
    return "\n".join([first, *report_errors(data["errors"], training.get("transmittance"), verbose)])


def fits_table(results: Mapping[str, dict[str, Any] | None]) -> str:
    """A row per fit: name → what the fit reported, or None where it failed."""
    rows = [["material", "unexplained variance", "PSNR", "beside the reference", "steps", "training"]]
    for name, result in results.items():
        if result is None:
            rows.append([name, "failed", "-", "-", "-", "-"])
            continue
        training, errors = result["training"], result["errors"]
        split = errors[headline(errors)]
        psnr, word = visibility(split)
        cells = [format_estimate(split["unexplained"]), psnr.removeprefix("PSNR "), word or "-"]
        rows.append([name, *cells, str(training["steps"]), clock(training["seconds"])])
    return format_table(rows)


def report_errors(
    errors: Mapping[str, Any],
    transmittance: Mapping[str, Any] | None,
    verbose: bool = False,
    *,
    foreign: bool = False,
) -> list[str]:
    """Three lines, and remarks: unexplained variance (where defined) and PSNR of the first split, and the
    former of other directions; if `verbose` a table of all splits, too. `foreign`: the errors are of the data
    of another material."""
    from mbtf_core.color import describe_exposure

    if not errors:
        return ["errors unknown"]
    first = headline(errors)
    split, of = errors[first], f"of {errors[first]['n']} {SPLIT_NAMES.get(first, first)}"
    lines = []
    if split["unexplained"]["value"] is not None:
        value = format_estimate(split["unexplained"])
        scale = unreliable(split) or "0: exact, 1: as good as the mean value"
        lines.append(f"unexplained variance {value} {of} ({scale})")
    text, word = visibility(split)
    if text != "PSNR unknown":
        shown = f"{text} {'' if lines else of + ' '}at {describe_exposure(split['exposure'])}"
        lines.append(shown if word is None else f"{shown}: {word} beside the reference")
    others = [
        f"{SPLIT_NAMES.get(name, name)} {format_estimate(found['unexplained'])}"
        for name, found in errors.items()
        if name == "held_out_directions" != first
    ]
    if transmittance:
        through = next(iter(transmittance.values()))
        square, noise = (through[name]["value"] for name in ("mse", "noise"))
        # The noise is at most that of independent paths.
        least, most = (max(0.0, x) ** 0.5 for x in (square - noise, square))
        others.append(f"rms error of transmittance between {least:.3f} and {most:.3f}")
    lines += [", ".join(others)] if others else []
    return [*lines, *_remarks(errors, foreign), *(_table_of(errors) if verbose else [])]


def _remarks(errors: Mapping[str, Any], foreign: bool) -> list[str]:
    """Notes on an undefined or large error."""
    found, split = [], errors[headline(errors)]
    value, measured = split["unexplained"]["value"], bool(split.get("includes_noise"))
    if value is None:
        why = "these values do not vary" if measured else "few bright values, or noise, decide the variance"
        found.append(f"undefined unexplained variance: {why}")
    if measured:
        found.append("these errors include the noise of the data, which have one value per query")
    found += outliers(split)
    color = split["color"]
    known = color.get("share", 0.0) >= _COLORED and color["value"] is not None
    if known and color["value"] - SIGNIFICANT * (color["error"] or 0.0) > _UNLEARNED:
        found.append(f"colors are hardly learned: {format_estimate(color)} of their variance is unexplained")
    return found if foreign else [*found, *above_one(split["unexplained"])]


def _table_of(errors: Mapping[str, Any]) -> list[str]:
    """A table of unexplained variance: overall, by level and by lowest cosine; a column per split. Rows
    without any are left out."""

    def cells(found: list[Mapping[str, Any] | None]) -> list[str]:
        known = [e if e is not None and e["unexplained"]["value"] is not None else None for e in found]
        return ["-" if e is None else format_estimate(e["unexplained"]) for e in known]

    splits = errors.values()
    rows = [["all", *cells([*splits])]]
    rows.append(["color alone", *cells([{"unexplained": split["color"]} for split in splits])])
    for grouping, label in (("levels", "level"), ("elevations", "cosine")):
        groups = {group for split in splits for group in split[grouping]}
        for group in sorted(groups, key=lambda g: float(g.split("-")[0])):
            rows.append([f"{label} {group}", *cells([split[grouping].get(group) for split in splits])])
    if all({*row[1:]} == {"-"} for row in rows):
        return []
    rows = [row for row in rows if row[0] == "all" or {*row[1:]} != {"-"}]
    partial = any("-" in row for row in rows)
    why = ["-: too few queries, or few bright values or noise decide the variance"] if partial else []
    why += [f"{SPLIT_NAMES.get(k, k)} {text}" for k, s in errors.items() if (text := unreliable(s))]
    rows.append(["queries", *(str(split["n"]) for split in splits)])
    names = ["unexplained variance", *(SPLIT_NAMES.get(name, name) for name in errors)]
    return [*format_table([names, *rows]).splitlines(), *why]

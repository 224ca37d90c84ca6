"""Results of the fitter as text and tables."""

from __future__ import annotations

from typing import Any

from mbtf_core.units import clock

SPLIT_NAMES = {
    "test": "test queries",
    "held_out_queries": "held-out queries",
    "held_out_directions": "held-out directions",
    "training": "training queries",
    "held_out": "held out",
}


def format_table(rows: list[list[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)


def describe_errors(errors: dict[str, Any], *, foreign: bool = False) -> list[str]:
    """A table of unexplained variance: overall, by level and by lowest cosine; a column per split.

    `foreign`: the errors are of the data of another material.
    """
    splits = list(errors)
    rows = [["unexplained variance", *(SPLIT_NAMES[name] for name in splits)]]
    rows.append(["all", *(format_estimate(errors[name]["unexplained"]) for name in splits)])
    for grouping, label in (("levels", "level"), ("elevations", "cosine")):
        groups = {group: None for name in splits for group in errors[name][grouping]}
        for group in sorted(groups, key=lambda g: float(g.split("-")[0])):
            found = [errors[name][grouping].get(group) for name in splits]
            rows.append(
                [
                    f"{label} {group}",
                    *("-" if e is None else format_estimate(e["unexplained"]) for e in found),
                ]
            )
    rows.append(["queries", *(str(errors[name]["n"]) for name in splits)])
    return [*format_table(rows).splitlines(), *_remarks(errors, foreign)]


def _remarks(errors: dict[str, Any], foreign: bool) -> list[str]:
    """Notes on undefined and large errors."""
    found = []
    groups = [g for e in errors.values() for g in (e, *e["levels"].values(), *e["elevations"].values())]
    if any(group["unexplained"]["value"] is None for group in groups):
        found.append("undefined: the noise exceeds the variance of these values")
    test = errors.get("test", {}).get("unexplained", {}).get("value")
    if test is not None and test >= 1 and not foreign:
        found.append(
            "above 1: worse than the mean value; generate more queries (mbtf-gen --queries), more paths per "
            "query (--spp), or a wider light (--light-width)"
        )
    return found


def describe_transmittance(errors: dict[str, Any] | None) -> list[str]:
    """A line per split: root mean square error, and the bound on its part that is noise of the data."""
    lines = []
    for name, e in (errors or {}).items():
        rms, noise, spread = (
            max(0.0, x) ** 0.5 for x in (e["mse"]["value"], e["noise"]["value"], e["variance"])
        )
        lines.append(
            f"transmittance, {SPLIT_NAMES[name]}: rms error {rms:.3f}, of which noise of the data at most "
            f"{noise:.3f} (standard deviation of the values {spread:.3f}; {e['n']} queries)"
        )
    return lines


def format_estimate(estimate: dict[str, Any]) -> str:
    if estimate["value"] is None:
        return "undefined"
    error = "?" if estimate["error"] is None else f"{estimate['error']:.3f}"
    return f"{estimate['value']:.3f} ± {error}"


def describe_coverage(coverage: dict[str, float]) -> str:
    """One line: levels whose texels have received gradients."""
    partly = [f"{share:.1%} of level {level}" for level, share in coverage.items() if share < 1]
    return f"gradients reached only {', '.join(partly)}" if partly else "gradients reached every texel"


def describe_fit(data: dict[str, Any]) -> str:
    training = data["training"]
    rate = training["steps"] * training["batch"] / max(training["seconds"], 1e-9)
    lines = [
        f"{data['material']}: {data['model']}, {training['steps']} steps of {training['batch']} queries in "
        f"{clock(training['seconds'])} on {training['device']} with {training['backend']} "
        f"({rate / 1e6:.2f} M queries/s)",
        describe_coverage(training["coverage"]),
        *describe_errors(data["errors"]),
        *describe_transmittance(training.get("transmittance")),
    ]
    return "\n".join(lines)

"""Results of the fitter as text and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from mbtf_core.units import clock

SPLIT_NAMES = {
    "test": "test queries",
    "held_out_queries": "held-out queries",
    "held_out_directions": "held-out directions",
    "training": "training queries",
    "held_out": "held out",
}


# Smallest PSNR in dB of each word for a fit beside its reference. There, the mean HDR-FLIP of pictures is
# that of grays that differ by 1, 2.3 and 5 in L*; materials vary by 3 dB.
VISIBILITY = (
    (40.0, "not visible"),
    (33.0, "barely visible"),
    (26.0, "visible"),
    (-math.inf, "clearly visible"),
)
# Standard errors of a significant difference from zero.
_SIGNIFICANT = 2.0


def visibility(split: Mapping[str, Any]) -> tuple[str, str | None]:
    """PSNR as text, and a word of :data:`VISIBILITY`, of the errors of a split; where the error is below its
    own uncertainty, lower bounds. None without an error."""
    from mbtf_core.exposure import white_of

    mse, error = split["mse"]["value"], split["mse"]["error"]
    # Materials of earlier versions record no exposure.
    if mse is None or error is None or "exposure" not in split:
        return "PSNR unknown", None
    resolved = mse > _SIGNIFICANT * error
    squared = mse if resolved else mse + _SIGNIFICANT * error
    if squared <= 0:
        return "PSNR infinite", VISIBILITY[0][1]
    psnr = 10.0 * math.log10(white_of(split["exposure"]) ** 2 / squared)
    word = next(word for least, word in VISIBILITY if psnr >= least)
    bound = not resolved and word != VISIBILITY[0][1]
    return f"PSNR {'' if resolved else 'above '}{psnr:.1f} dB", f"at most {word}" if bound else word


def headline(errors: Mapping[str, Any]) -> str:
    """The split whose errors are reported first: test, else held-out queries, else any."""
    return next((name for name in ("test", "held_out_queries") if name in errors), next(iter(errors)))


def summarize_errors(
    errors: dict[str, Any], transmittance: dict[str, Any] | None = None, *, foreign: bool = False
) -> list[str]:
    """Three lines, and advice: unexplained variance (where defined) and PSNR of the first split, and the
    other splits. `foreign`: the errors are of the data of another material."""
    from mbtf_core.exposure import describe_exposure

    first = headline(errors)
    split, of = errors[first], f"of {errors[first]['n']} {SPLIT_NAMES[first]}"
    lines = []
    if split["unexplained"]["value"] is not None:
        value = format_estimate(split["unexplained"])
        lines.append(f"unexplained variance {value} {of} (0: exact, 1: as good as the mean value)")
    text, word = visibility(split)
    if word is not None:
        shown = describe_exposure(split["exposure"])
        lines.append(f"{text} {'' if lines else of + ' '}at {shown}: {word} beside the reference")
    others = [
        f"{SPLIT_NAMES[name]} {format_estimate(errors[name]['unexplained'])}"
        for name in errors
        if name != first
    ]
    if transmittance:
        found = next(iter(transmittance.values()))
        others.append(f"rms error of transmittance {max(0.0, found['mse']['value']) ** 0.5:.3f}")
    return [*lines, *([", ".join(others)] if others else []), *_remarks({first: split | _NO_GROUPS}, foreign)]


_NO_GROUPS: dict[str, Any] = {"levels": {}, "elevations": {}}


def format_table(rows: list[list[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)


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
    measured = bool(errors[headline(errors)].get("includes_noise"))
    if any(group["unexplained"]["value"] is None for group in groups):
        why = "these values do not vary" if measured else "the noise exceeds the variance of these values"
        found.append(f"undefined unexplained variance: {why}")
    if measured:
        found.append("these errors include the noise of the data, which have one value per query")
    value = errors[headline(errors)]["unexplained"]["value"]
    if value is not None and value >= 1 and not foreign:
        advice = "generate more queries (mbtf-gen --queries), more paths per query (--spp), or a wider light "
        advice = "import more queries (mbtf-gen import --queries)" if measured else f"{advice}(--light-width)"
        found.append(f"above 1: worse than the mean value; {advice}")
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
    """One line: levels whose texels have received gradients. Those that are coarser than all data have none:
    their texels are averages."""
    left = list(coverage.items())
    while len(left) > 1 and left[0][1] == 0:
        del left[0]
    partly = [f"{share:.1%} of level {level}" for level, share in left if share < 1]
    found = f"gradients reached only {', '.join(partly)}" if partly else "gradients reached every texel"
    if len(left) == len(coverage):
        return found
    return f"{found}; levels coarser than {left[0][0]} have no data and are averages of it"


def report_errors(
    errors: dict[str, Any],
    transmittance: dict[str, Any] | None,
    verbose: bool = False,
    *,
    foreign: bool = False,
) -> list[str]:
    """The summary, followed by the tables if `verbose`. `foreign`: as in :func:`summarize_errors`."""
    lines = summarize_errors(errors, transmittance, foreign=foreign)
    if not verbose:
        return lines
    return [*lines, *describe_errors(errors, foreign=foreign), *describe_transmittance(transmittance)]


def describe_fit(data: dict[str, Any], verbose: bool = False) -> str:
    training = data["training"]
    rate = training["steps"] * training["batch"] / max(training["seconds"], 1e-9)
    lines = [
        f"{data['material']}: {data['model']}, {training['steps']} steps of {training['batch']} queries in "
        f"{clock(training['seconds'])} on {training['device']} with {training['backend']} "
        f"({rate / 1e6:.2f} M queries/s)",
        *report_errors(data["errors"], training.get("transmittance"), verbose),
    ]
    if verbose or min(training["coverage"].values(), default=1) < 1:
        lines.insert(1, describe_coverage(training["coverage"]))
    return "\n".join(lines)

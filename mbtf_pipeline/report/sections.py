"""Template data of the report's sections: errors, training, time, material and versions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median_high
from typing import Any

import numpy as np

from mbtf_core.color import linear_to_srgb
from mbtf_core.errors import MbtfError
from mbtf_core.images.resample import shrink
from mbtf_core.stats import Estimate, is_significant
from mbtf_fit.formatting import SPLIT_NAMES
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.tile.inspection import brief_warnings, inspection_text
from mbtf_gen.tile.loading import latest_material
from mbtf_pipeline.report.images import U8, Pixels, data_uri
from mbtf_pipeline.report.plots import Series, plot, points
from mbtf_pipeline.stages import FITS, read_stamp
from mbtf_pipeline.tables import NOT_SIGNIFICANT, data_errors, estimate

UNEXPLAINED = "unexplained variance"
# Ways to group queries: key in the record, title, axis of the plot, and head of the table.
_GROUPINGS = (
    ("levels", "By level of detail (level 0: the whole tile)", "level of the footprint", "level"),
    ("elevations", "By lower cosine of light and view", "lower cosine of light and view", "cos θ"),
)
# Largest width and height of a map's thumbnail, pixels.
_THUMBNAIL = 192


def error_context(comparison: Mapping[str, Any], training: Mapping[str, Any]) -> dict[str, Any]:
    """Data about errors; `training` is that of :func:`training_context`."""
    tests = {fit: record["splits"]["test"] for fit, record in comparison["test"].items()}
    titles = {fit: _with_caveat(fit, errors["unexplained"], training) for fit, errors in tests.items()}
    groupings = [shown for grouping in _GROUPINGS if (shown := _grouping(tests, *grouping)) is not None]
    return {
        "facts": _facts(comparison, tests, titles),
        "test": next(iter(tests.values())),
        "error_table": _error_table(comparison, titles),
        "error_plots": [shown for shown, _ in groupings],
        "group_tables": [table for _, table in groupings],
    }


def _facts(
    comparison: Mapping[str, Any], tests: Mapping[str, Any], titles: Mapping[str, str]
) -> list[dict[str, str]]:
    fit, out = comparison["fits"][0], []
    for name, errors in tests.items():
        equal = "" if _differs(comparison, name) else f"; difference from {fit} {NOT_SIGNIFICANT}"
        what = f"{UNEXPLAINED} of {titles[name]}{equal}"
        out.append({"value": data_errors(errors)[0], "what": what})
    records = [p["fits"][fit] for p in comparison["pictures"]]
    decibels = [r["errors"][comparison["kinds"][0]]["psnr"]["value"] for r in records]
    if finite := [d for d in decibels if d is not None]:
        images = "the image" if len(decibels) == 1 else f"{len(decibels)} images (median)"
        what = f"PSNR of {fit} over {images}"
        out.append({"value": f"{median_high(finite):.1f} dB", "what": what})
    flip = median_high(r["flip"]["hdr"] for r in records)
    out.append({"value": f"{flip:.3f}", "what": f"HDR-FLIP of {fit}, likewise (0 is best)"})
    record = comparison["test"][fit]
    size = 4 * (record["network_weights"] + record["texels"]) / 1024
    out.append({"value": f"{size:,.0f} KiB", "what": f"{fit}: textures and networks as float32"})
    return out


def _with_caveat(fit: str, unexplained: Mapping[str, Any], training: Mapping[str, Any]) -> str:
    """The name of a fit, and why its error does not rank its model."""
    from mbtf_fit.training.validation import caveat

    text = caveat(training["histories"][fit], training["trainings"][fit], unexplained)
    return f"{fit} ({text})" if text else fit


def _differs(comparison: Mapping[str, Any], fit: str) -> bool:
    """Whether a fit is the first one, or differs from it significantly on the test queries."""
    difference = comparison["test"][fit].get("mse_minus_first")
    return difference is None or is_significant(estimate(difference))


def _error_table(comparison: Mapping[str, Any], titles: Mapping[str, str]) -> dict[str, Any]:
    splits = list(next(iter(comparison["test"].values()))["splits"])
    errors = [f"{UNEXPLAINED}, {SPLIT_NAMES[s]}" for s in splits]
    rows = []
    for fit, record in comparison["test"].items():
        cells = [data_errors(record["splits"][s])[0] if s in record["splits"] else "–" for s in splits]
        mse = data_errors(record["splits"]["test"])[1]
        cells += [mse, f"{record['training_steps']:,}", f"{record['training_seconds']:.0f}"]
        rows.append([titles[fit], *cells, f"{record['network_weights']:,}", f"{record['texels']:,}"])
    head = ["fit", *errors, "MSE, test [10⁻³/sr²]", "training steps", "training [s]"]
    head += ["network weights", "texture values"]
    return {"head": head, "rows": rows}


def _grouping(
    tests: Mapping[str, Any], key: str, title: str, axis: str, head: str
) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """Plot and table of the errors by level or by cosine; None where none is defined."""
    names = sorted({n for test in tests.values() for n in test[key]}, key=lambda n: float(n.split("-")[0]))
    known = [
        n
        for n in names
        if any(math.isfinite(_unexplained(test[key].get(n)).value) for test in tests.values())
    ]
    if not known:
        return None
    labels = {name: name.replace("-", "–") for name in names}
    unknown = ", ".join(labels[name] for name in names if name not in known)
    why = "too few queries, or few bright values or noise decide the variance"
    note = f"Without {unknown}: {why}." if unknown else ""
    series: dict[str, list[tuple[float, float] | None]] = {fit: [] for fit in tests}
    rows = []
    for name in known:
        groups = {fit: test[key].get(name) for fit, test in tests.items()}
        count = next(group["mse"]["n"] for group in groups.values() if group is not None)
        row = [labels[name], f"{count:,}"]
        for fit, group in groups.items():
            found = _unexplained(group)
            series[fit].append((found.value, found.error) if math.isfinite(found.value) else None)
            row += ("–", "–") if group is None else data_errors(group)
        rows.append(row)
    svg = points([labels[name] for name in known], series, axis, UNEXPLAINED, f"{UNEXPLAINED} {title}")
    heads = [h for fit in tests for h in (f"{fit}: {UNEXPLAINED}", f"{fit}: MSE [10⁻³/sr²]")]
    table = {"title": f"{title}, test split", "head": [head, "queries", *heads], "rows": rows, "note": note}
    return {"title": title, "svg": svg}, table


def _unexplained(group: Mapping[str, Any] | None) -> Estimate:
    return Estimate(math.nan, math.inf, 0) if group is None else estimate(group["unexplained"])


def training_context(fits: Mapping[str, Path]) -> dict[str, Any]:
    """Data about training, from the folders of the fits; an InputError where one contains no material."""
    from mbtf_fit import Material, read_history

    histories = {name: read_history(folder) for name, folder in fits.items()}
    plots = []
    for title, label, y, key in (
        ("Training loss, including noise", "training loss over seconds", "training loss", "loss"),
        ("Validation error, noise-free", "error over seconds", UNEXPLAINED, "unexplained"),
    ):
        series = []
        for name, records in histories.items():
            rows = [(r["seconds"], r.get(key), r.get(f"{key}_error", 0.0)) for r in records]
            if finite := [row for row in rows if all(x is not None and math.isfinite(x) for x in row)]:
                seconds, values, errors = zip(*finite, strict=True)
                series.append(Series(name, seconds, values, errors))
        if series:
            plots.append({"title": title, "svg": plot(series, "seconds of training", y, label, log="y")})
    trainings = {name: Material.load(folder).description["training"] for name, folder in fits.items()}
    return {"training_plots": plots, "trainings": trainings, "histories": histories}


def time_tables(folder: Path, stages: Sequence[str], comparison: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Tables of the time that each part of a run took, by the names of its finished stages."""
    stamps = {name: read_stamp(folder, name) for name in stages}
    each = {name: stamp.seconds for name, stamp in stamps.items() if stamp is not None}
    images = {"references": f"{comparison['seconds']['references'] / len(comparison['pictures']):.1f}"}
    for fit in comparison["fits"]:
        # The median is robust against images that another process slowed down.
        images[fit] = f"{np.median([p['fits'][fit]['seconds'] for p in comparison['pictures']]):.3g}"
    stage_seconds = {name: f"{s:.1f}" for name, s in each.items()} | {"total": f"{sum(each.values()):.1f}"}
    return [
        {"title": "Seconds per stage", **_as_table(stage_seconds)},
        {"title": "Compare: seconds per image", **_as_table(images)},
    ]


def _as_table(row: Mapping[str, str]) -> dict[str, Any]:
    return {"head": list(row), "rows": [list(row.values())]}


def material_section(config: GeneratorConfig, inputs: Mapping[str, str]) -> dict[str, Any]:
    """Describe the material of a data set, unless its files have other digests than when it was generated:
    ``maps``, a figure of each; ``warnings``; ``inspection``, text of ``mbtf-gen inspect``; ``missing``, why
    there is nothing of it, empty otherwise."""
    nothing = {"maps": [], "warnings": [], "inspection": ""}
    geometry = config.geometry
    try:
        material = latest_material(config.material, geometry.make_tileable, geometry.max_pixels)
        found = material.inspect(geometry)
        text = inspection_text(found, config.material)
    except (MbtfError, OSError) as error:
        return nothing | {"missing": f"The material cannot be read any more: {error}"}
    if material.digests != inputs:
        return nothing | {"missing": f"{config.material} has changed since the data set was generated."}
    maps = []
    for role, facts in found.get("maps", {}).items():
        value = material.images.get(role)
        if value is None or np.ndim(value) < 2:
            continue
        name, title = Path(facts["file"]).name, role.replace("_", " ").capitalize()
        lines = [name, f"{facts['columns']} × {facts['rows']}"]
        if role == "height":
            lines.append(f"{facts['low']:.4g} (black) to {facts['high']:.4g} (white)")
        image = data_uri(_thumbnail(role, np.asarray(value)), "jpeg")
        maps.append({"label": title, "lines": lines, "image": image, "alt": f"{title}: {name}", "file": ""})
    return {"maps": maps, "warnings": brief_warnings(found["warnings"]), "inspection": text, "missing": ""}


def _thumbnail(role: str, value: Pixels) -> U8:
    """A thumbnail: colors as sRGB, normals from [-1, 1], heights from their range, other maps as stored."""
    small: Pixels = shrink(value, -(-max(value.shape[:2]) // _THUMBNAIL)).astype(np.float64)
    if role.endswith("color"):
        small = linear_to_srgb(np.clip(small, 0.0, 1.0))
    elif role == "normal":
        small = 0.5 + 0.5 * small
    elif role == "height":
        low, high = value.min(), value.max()
        small = (small - low) / (high - low if high > low else 1.0)
    return np.round(255.0 * np.clip(small, 0.0, 1.0)).astype(np.uint8)


def provenance(
    folder: Path, manifest: Mapping[str, Any], fits: Sequence[str], machine: Mapping[str, str]
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

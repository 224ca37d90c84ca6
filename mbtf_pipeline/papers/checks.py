"""Tables besides errors: parameter counts, time of an evaluation, offsets, unmodified Mitsuba."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.image_files import read_picture
from mbtf_pipeline.compare.unmodified_mitsuba import (
    MAX_STANDARD_ERRORS,
    MEAN_TOLERANCE,
    MIN_BLOCKS,
    RMS_TOLERANCE,
    verdict,
)
from mbtf_pipeline.number_text import direction, estimate, is_significant
from mbtf_pipeline.papers.published import Published, network_weights
from mbtf_pipeline.papers.runs import MATERIAL, METHOD, FinishedRun, each_fit, preview, signed_map
from mbtf_pipeline.report.images import displacements
from mbtf_pipeline.run_folder import COMPARE
from mbtf_pipeline.tables import Cell, Column, Table, Thumbnail, rows_of


def weights(runs: Sequence[FinishedRun], published: Sequence[Published]) -> list[Table]:
    """Parameter counts of every model, beside published ones."""
    run = runs[0]
    columns = [
        METHOD,
        Column("decoder", "decoder", lambda run, fit: run.fit(fit)["networks"]["decoder"]),
        Column(
            "offset network", "offset_network", lambda r, fit: r.fit(fit)["networks"].get("offset_network", 0)
        ),
        Column("all networks", "network_weights", lambda run, fit: run.fit(fit)["network_weights"]),
        Column("texture values", "texels", lambda run, fit: run.fit(fit)["texels"]),
        Column("float32 [KiB]", "kib", _kibibytes, digits=",.0f"),
        Column("published", "published", lambda r, fit: network_weights(published, r.fit(fit)["model"])[0]),
        Column("source", "source", lambda r, fit: network_weights(published, r.fit(fit)["model"])[1]),
    ]
    across = 2 ** run.comparison["finest"]
    text = f"Counts include biases. Textures have {across} texels across at the finest level."
    return [Table("weights", "Parameter counts", text, columns, rows_of(columns, each_fit(runs[:1])))]


def _kibibytes(run: FinishedRun, fit: str) -> float:
    record = run.fit(fit)
    return float((record["network_weights"] + record["texels"]) / 256)


_TIMING_TEXT = (
    "Milliseconds for one query per pixel of 1920 × 1080: the median of three timings after a warm-up run. "
    "The first number is the evaluation of a material, which uses a compiled kernel on the CPU if the "
    "model has one. The others are parts timed in PyTorch. Stage 1 (offset and lookup) depends on the view "
    "only and is shared by all lights; stage 2 runs once per light. An eighth of the pixels is evaluated, "
    "fewer for models that read several positions per query, and the times are scaled up."
)


def timing(runs: Sequence[FinishedRun], published: Sequence[Published]) -> list[Table]:
    """Milliseconds of one evaluation of 1080p, in total and by part."""
    items = [
        (fit, record)
        for run in runs
        for fit, records in run.comparison.get("timing", {}).items()
        for record in records
    ]

    def milliseconds(title: str, key: str, *path: str) -> Column:
        """Milliseconds at a path in the record of a timing."""

        def get(fit: str, record: Any) -> Cell:
            for name in path:
                record = record.get(name)
            return record

        return Column(title, f"{key}_ms", get, digits=",.1f")

    lights = items[-1][1]["lights_ms"] if items else ()
    columns = [
        Column("method", "method", lambda fit, record: fit),
        Column("device", "device", lambda fit, record: record["device"]),
        milliseconds("material evaluation", "evaluate", "evaluate_ms"),
        milliseconds("offset texture", "offset_texture", "parts_ms", "offset texture"),
        milliseconds("offset network", "offset_network", "parts_ms", "offset network"),
        milliseconds("pyramid", "pyramid", "parts_ms", "pyramid"),
        milliseconds("encoded position", "encoding", "parts_ms", "encoding"),
        milliseconds("stage 1 (per view)", "stage1", "stage1_ms"),
        milliseconds("stage 2 (per light): decoder", "stage2", "stage2_ms"),
        *(milliseconds(f"{n} light{'s' * (n != '1')}", f"lights_{n}", "lights_ms", n) for n in lights),
        Column("timed queries", "queries", lambda fit, record: record["queries"]),
    ]
    text = " ".join([_TIMING_TEXT, *(f"{p.source}: {p.timing}." for p in published if p.timing)])
    rows = rows_of(columns, items)
    return [Table("timing", "Time of one evaluation of 1080p", text, columns, rows)]


def _view(title: str, key: str) -> Column:
    return Column(title, key, lambda run, fit, record: float(record["view"][key]), digits=".0f")


def _learned(title: str, key: str, name: str, digits: str) -> Column:
    return Column(title, name, lambda run, fit, record: record["fits"][fit][key], digits=digits)


_OFFSETS = (
    MATERIAL,
    METHOD,
    _view("view: elevation", "elevation"),
    _view("azimuth", "azimuth"),
    Column("spread, traced [tile widths]", "spread_traced", lambda *item: item[-1]["spread"], digits=".2g"),
    _learned("spread, learned [tile widths]", "spread", "spread_learned", ".2g"),
    _learned("correlation", "correlation", "correlation", ".2f"),
    _learned("slope of learned on traced", "slope", "slope", ".2f"),
)
_OFFSETS_TEXT = (
    "Displacement towards the viewer between the point where a view ray crosses the reference plane and "
    "the visible surface. Spread is the standard deviation over the tile. A slope of 1 means equal "
    "magnitude. Fits learn their offsets from colors only, so the offsets need not agree with the traced "
    "ones. Images of a row share one scale, blue away from the viewer and orange towards; the median of "
    "each image is subtracted."
)


def offsets(runs: Sequence[FinishedRun], published: Sequence[Published]) -> list[Table]:
    """Agreement of learned and traced offsets for every view."""
    items = [
        (run, fit, record)
        for run, fit in each_fit(runs)
        for record in run.comparison["offsets"]
        if fit in record["fits"]
    ]
    rows, images = rows_of(_OFFSETS, items), [row for run in runs for row in _offset_images(run)]
    return [Table("offsets", "Learned offsets by view angle", _OFFSETS_TEXT, _OFFSETS, rows, images=images)]


def _offset_images(run: FinishedRun) -> list[tuple[str, list[Thumbnail]]]:
    out = []
    records = run.comparison["offsets"]
    for fit in (None, *records[0]["fits"]) if records else ():
        maps, _, scale = displacements(run.folder / COMPARE, records, fit)
        row = [
            signed_map(m, scale, f"elevation {record['view']['elevation']:g}°")
            for m, record in zip(maps, records, strict=True)
        ]
        out.append((f"{run.title}, {fit or 'traced'}: ± {scale:.2g} tile widths", row))
    return out


_RENDERERS = {"base color": "unmodified Mitsuba", "full": "Mitsuba with the BSDF of mbtf"}
# The difference images saturate at this fraction of white.
_SCALE = 0.1
_INDEPENDENCE_TEXT = (
    "The filtered image near normal incidence under a delta light, rendered by mbtf and by Mitsuba. "
    "Mitsuba renders a block of instances of the tile’s mesh with the emitter directional, the sensor "
    "perspective with a Gaussian filter of half a pixel, and the integrator path. The base color uses "
    "Mitsuba’s BSDF diffuse; the full surface uses the BSDF of mbtf in both. Opacity is ignored. The "
    f"images agree if their means differ by less than {100 * MEAN_TOLERANCE:g} % and their pixels by less "
    f"than {100 * RMS_TOLERANCE:g} % RMS, or if the differences lie within {MAX_STANDARD_ERRORS:g} "
    "standard errors. Images with fewer than 20 pixels a side are inconclusive. The detection limit is the "
    "smallest RMS difference that would be detected despite the noise."
)


def _rms_text(square: Estimate) -> str | None:
    """Root of a noise-free mean square in percent; an upper limit if it is not significant. None for images
    that are too small."""
    if square.n < MIN_BLOCKS:
        return None
    if square.value <= 0 or not is_significant(square):
        return f"below {100 * math.sqrt(max(square.value, 0.0) + 2.0 * square.error):.2g} %"
    root = math.sqrt(square.value)
    return f"{Estimate(100 * root, 100 * square.error / (2 * root), square.n)} %"


def _detectable(square: Estimate) -> float | None:
    return math.sqrt(MAX_STANDARD_ERRORS * square.error) if square.n >= MIN_BLOCKS else None


# Of a run, the record of a surface, and its differences of the mean and in mean square.
_INDEPENDENCE = (
    MATERIAL,
    Column("surface", "surface", lambda run, found, *_: found["surface"]),
    Column("renderer", "renderer", lambda run, found, *_: _RENDERERS[found["surface"]]),
    Column("difference of the means [% of the mean]", "mean", lambda run, found, mean, _: mean, 100.0),
    Column("RMS difference, noise-free [% of the mean]", "rms", lambda *item: _rms_text(item[-1])),
    Column("detection limit, RMS [%]", "rms_detectable", lambda *item: _detectable(item[-1]), 100.0, ".2g"),
    Column("verdict", "verdict", lambda run, found, mean, square: verdict(mean, square)),
)


def independence(runs: Sequence[FinishedRun], published: Sequence[Published]) -> list[Table]:
    """Differences of both renderers, per material and surface."""
    checks = [(run, run.comparison.get("unmodified_mitsuba")) for run in runs]
    surfaces = [(run, found) for run, check in checks if check for found in check["surfaces"]]
    items = [(run, found, estimate(found["mean"]), estimate(found["square"])) for run, found in surfaces]
    rows, images = rows_of(_INDEPENDENCE, items), [_surface_images(*one) for one in surfaces]
    title = "References rendered with unmodified Mitsuba"
    return [Table("independence", title, _INDEPENDENCE_TEXT, _INDEPENDENCE, rows, images=images)]


def _surface_images(run: FinishedRun, found: Mapping[str, Any]) -> tuple[str, list[Thumbnail]]:
    check = run.comparison["unmodified_mitsuba"]
    mbtf, mitsuba = (run.file(found["files"][renderer]) for renderer in ("mbtf", "mitsuba"))
    title = (
        f"{run.title}, {found['surface']}: view {direction(check['view'])}, light {direction(check['light'])}"
    )
    note = f"saturates at ± {_SCALE:.0%} of white; includes the noise of both"
    own, other = (read_picture(path).astype(np.float64) for path in (mbtf, mitsuba))
    scale = _SCALE * run.comparison["white"]
    signed = signed_map((own - other).mean(axis=-1), scale, "mbtf − Mitsuba", note)
    return title, [preview(mbtf, "mbtf"), preview(mitsuba, "Mitsuba"), signed]

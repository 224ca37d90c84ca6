"""One reference per material, rendered again with unmodified Mitsuba."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.pictures import read_picture
from mbtf_pipeline.compare.unmodified_mitsuba import (
    MAX_STANDARD_ERRORS,
    MEAN_TOLERANCE,
    MIN_BLOCKS,
    RMS_TOLERANCE,
    verdict,
)
from mbtf_pipeline.formatting import direction, estimate, is_significant
from mbtf_pipeline.papers.cells import (
    MATERIAL,
    Column,
    Table,
    Thumbnail,
    preview,
    rows_of,
    signed_map,
)
from mbtf_pipeline.papers.runs import FinishedRun

_RENDERERS = {"base color": "unmodified Mitsuba", "full": "Mitsuba with the BSDF of mbtf"}
# The difference images saturate at this fraction of white.
_SCALE = 0.1
_TEXT = (
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
_COLUMNS = (
    MATERIAL,
    Column("surface", "surface", lambda run, found, *_: found["surface"]),
    Column("renderer", "renderer", lambda run, found, *_: _RENDERERS[found["surface"]]),
    Column("difference of the means [% of the mean]", "mean", lambda run, found, mean, _: mean, 100.0),
    Column("RMS difference, noise-free [% of the mean]", "rms", lambda *item: _rms_text(item[-1])),
    Column("detection limit, RMS [%]", "rms_detectable", lambda *item: _detectable(item[-1]), 100.0, ".2g"),
    Column("verdict", "verdict", lambda run, found, mean, square: verdict(mean, square)),
)


def independence(runs: Sequence[FinishedRun]) -> list[Table]:
    """Differences of both renderers, per material and surface."""
    checks = [(run, run.comparison.get("unmodified_mitsuba")) for run in runs]
    surfaces = [(run, found) for run, check in checks if check for found in check["surfaces"]]
    items = [(run, found, estimate(found["mean"]), estimate(found["square"])) for run, found in surfaces]
    title = "References rendered with unmodified Mitsuba"
    images = [_images(run, found) for run, found in surfaces]
    return [Table("independence", title, _TEXT, _COLUMNS, rows_of(_COLUMNS, items), images=images)]


def _images(run: FinishedRun, found: Mapping[str, Any]) -> tuple[str, list[Thumbnail]]:
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

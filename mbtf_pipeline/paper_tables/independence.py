"""One reference per material rendered again by stock parts of Mitsuba alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.unmodified_mitsuba import (
    BARS,
    LEAST_SQUARES,
    MEAN_TOLERANCE,
    RMS_TOLERANCE,
    verdict,
)
from mbtf_pipeline.formatting import direction, estimate
from mbtf_pipeline.paper_tables.cells import Cell, Column, Figure, Table
from mbtf_pipeline.paper_tables.figures import difference, picture
from mbtf_pipeline.paper_tables.runs import Run, name_of

_ROUTES = {"base color": "stock parts alone", "full": "stock parts, the project’s surface"}
# Colors of the difference pictures are full at this share of white.
_SCALE = 0.1


def independence(runs: Sequence[Run]) -> list[Table]:
    """Differences of both routes, per material and surface."""
    columns = [
        Column("material", "material"),
        Column("surface", "surface"),
        Column("rendered by", "route"),
        Column("difference of the means [% of the mean]", "mean", 100.0, second="se"),
        Column("RMS difference, noise-free [% of the mean]", "rms"),
        Column("RMS that would be seen [%]", "rms_seen", 100.0, digits=".2g"),
        Column("verdict", "verdict"),
    ]
    rows: list[list[Cell]] = []
    figures: list[tuple[str, list[Figure]]] = []
    for run in runs:
        record = run.comparison.get("stock")
        if record is None:
            continue
        for found in record["surfaces"]:
            square = estimate(found["square"])
            rows.append(
                [
                    name_of(run.material),
                    found["surface"],
                    _ROUTES[found["surface"]],
                    estimate(found["mean"]),
                    _rms_text(square) if square.n >= LEAST_SQUARES else None,
                    math.sqrt(BARS * square.error) if square.n >= LEAST_SQUARES else None,
                    verdict(estimate(found["mean"]), square),
                ]
            )
            ours, stock = (run.picture(found["files"][route]) for route in ("ours", "stock"))
            figures.append(
                (
                    f"{name_of(run.material)}, {found['surface']}: view {direction(record['view'])}, "
                    f"light {direction(record['light'])}",
                    [
                        Figure(picture(ours), "ours"),
                        Figure(picture(stock), "stock"),
                        Figure(
                            difference(ours, stock, _SCALE * run.comparison["white"]),
                            "ours − stock",
                            [f"full color at ± {_SCALE:.0%} of white; noise of both shows"],
                        ),
                    ],
                )
            )
    text = (
        "The filtered picture near normal incidence, under a directional light without width: ours, and "
        "by stock parts (a block of instances of the tile’s mesh, the emitter directional, the sensor "
        "perspective with a Gaussian filter of half a pixel, the integrator path). With the base color "
        "alone everything is stock, the surface, too (diffuse); the full surface is the project’s in "
        "both, under stock everything else. Holes are left out. The two agree where the means differ by "
        f"less than {100 * MEAN_TOLERANCE:g} % and pixels by less than {100 * RMS_TOLERANCE:g} % RMS, or "
        "by less than three error bars, which pictures of less than 20 pixels a side are too small for; the "
        "last but one column is the smallest RMS difference that the noise would let be seen."
    )
    return [Table("independence", "References by stock parts", text, columns, rows, figures=figures)]


def _rms_text(square: Estimate) -> str:
    """Root of a noise-free mean square, in percent; it may be negative, where noise hides it."""
    if square.value <= 2.0 * square.error:
        return f"below {100 * math.sqrt(max(square.value, 0.0) + 2.0 * square.error):.2g} %"
    root = math.sqrt(square.value)
    return f"{Estimate(100 * root, 100 * square.error / (2 * root), square.n)} %"

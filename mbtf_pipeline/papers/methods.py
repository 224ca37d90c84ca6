"""Comparison of methods: errors on data and images, and ratios beside published ones."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.perceptual_metrics import PERCEPTUAL_METRICS, PerceptualMetric
from mbtf_pipeline.formatting import estimate, signed
from mbtf_pipeline.papers.cells import (
    MATERIAL,
    METHOD,
    Cell,
    Column,
    Shown,
    Table,
    Thumbnail,
    mean_of,
    perceptual_cell,
    preview,
    psnr_cell,
    ratio_of,
    rows_of,
)
from mbtf_pipeline.papers.published import mse_ratio
from mbtf_pipeline.papers.runs import FinishedRun, each_fit

# Records of images.
Pictures = Sequence[dict[str, Any]]


def methods(runs: Sequence[FinishedRun]) -> list[Table]:
    """Errors of every method on every material, and ratios of MSE beside published ones."""
    return [_errors(runs), _ratios(runs)]


def _metric_column(metric: PerceptualMetric) -> Column:
    def mean(run: FinishedRun, fit: str, pictures: Pictures | None = None) -> Shown | None:
        """Mean over images; None if one of them has no value."""
        chosen = pictures or run.pictures
        value = _mean([metric.of(p["fits"][fit]) for p in chosen])
        noise = _mean([metric.of(p["references"][run.kind]) for p in chosen])
        return None if value is None else perceptual_cell(metric, value, noise)

    return Column(metric.title, metric.key.replace(".", "_"), mean)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if len(known) == len(values) else None


# Cells are means over the images given as a third argument, by default over all.
METRIC_COLUMNS = [_metric_column(m) for m in PERCEPTUAL_METRICS]


def picture_error(
    run: FinishedRun, fit: str, key: str, pictures: Pictures | None = None, kind: str = ""
) -> Estimate:
    """Mean over images of ``mse`` or ``relative_mse``."""
    errors = [p["fits"][fit]["errors"][kind or run.kind] for p in pictures or run.pictures]
    return mean_of([estimate(e[key]) for e in errors])


def _psnr(run: FinishedRun, fit: str) -> Shown:
    return psnr_cell(picture_error(run, fit, "mse"), run.comparison["white"])


_ERRORS = [
    MATERIAL,
    METHOD,
    Column("unexplained variance [%]", "unexplained", FinishedRun.unexplained, 100.0),
    Column("MSE [10⁻³/sr²]", "mse", FinishedRun.mse, 1e3),
    Column("MSE − MSE of the first method [10⁻³/sr²]", "mse_minus_first", FinishedRun.minus_first, 1e3),
    Column("PSNR of images", "psnr", _psnr),
    Column("relative MSE of images", "relative_mse", lambda r, fit: picture_error(r, fit, "relative_mse")),
    *METRIC_COLUMNS,
    Column("training [s]", "training_seconds", FinishedRun.seconds, digits=".0f"),
    Column("network weights", "network_weights", lambda run, fit: run.fit(fit)["network_weights"]),
]


def _errors(runs: Sequence[FinishedRun]) -> Table:
    rows = rows_of(_ERRORS, each_fit(runs))
    text = (
        "Unexplained variance and MSE are measured on the same test queries of each material, which are "
        "not used for training. The other metrics are means over the same path-traced images. MSE, "
        "relative MSE and PSNR are noise-free; FLIP, SSIM and ST-LPIPS include the noise of the reference. "
        "Differences are paired: they use the same queries."
    )
    return Table("methods", "Comparison of methods", text, _ERRORS, rows, images=_images(runs))


def _images(runs: Sequence[FinishedRun]) -> list[tuple[str, list[Thumbnail]]]:
    """The last image of every run: reference and fits."""
    out = []
    for run in runs:
        shown = run.pictures[-1]
        row = [preview(run.file(shown["references"][run.kind]["file"]), "reference")]
        for fit in run.fits:
            record = shown["fits"][fit]
            psnr = record["errors"][run.kind]["psnr"]["value"]
            line = "" if psnr is None else signed(f"{psnr:.1f} dB")
            row.append(preview(run.file(record["file"]), fit, line))
        out.append((run.title, row))
    return out


def _ratios(runs: Sequence[FinishedRun]) -> Table:
    columns = [
        MATERIAL,
        METHOD,
        Column("relative to", "relative_to"),
        Column("MSE ratio, measured here", "measured"),
        Column("MSE ratio, published for another material of the same name or kind", "published"),
        Column("source", "source"),
    ]
    rows: list[list[Cell]] = []
    for run in runs:
        for base, fit in combinations(run.fits, 2):
            published = mse_ratio(run.material, fit, base) or (None, None)
            rows.append([run.title, fit, base, ratio_of(run.mse(fit), run.mse(base)), *published])
    text = (
        "A ratio below 1 means that the method is better than the one it is divided by. Published numbers "
        "belong to other data: another material of the same name or kind, other light, other training. The "
        "errors of the two MSEs are taken as independent, which overestimates the error bars."
    )
    return Table("ratios", "MSE ratios beside published ones", text, columns, rows)

"""Method comparison: errors on data and pictures, and ratios beside published ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.perceptual_metrics import MEASURES, Measure
from mbtf_pipeline.formatting import estimate
from mbtf_pipeline.paper_tables.cells import (
    NOT_BUILT,
    Cell,
    Column,
    Decibel,
    Figure,
    Seen,
    Table,
    mean_of,
    ratio_of,
)
from mbtf_pipeline.paper_tables.figures import picture
from mbtf_pipeline.paper_tables.published import NOT_HERE, mse_ratio
from mbtf_pipeline.paper_tables.runs import Run, name_of


def methods(runs: Sequence[Run]) -> list[Table]:
    """Errors of every method on every material, and ratios of MSE beside published ones."""
    return [_errors(runs), _ratios(runs)]


def visible_columns() -> list[Column]:
    """Columns of all visible measures."""
    return [Column(m.title, m.key.replace(".", "_"), second="noise") for m in MEASURES]


def mean_seen(run: Run, fit: str, measure: Measure, pictures: Sequence[dict[str, Any]] | None = None) -> Cell:
    """Mean of a measure over pictures; None where one of them has none."""
    chosen = run.pictures if pictures is None else pictures
    values = [measure.of(p["fits"][fit]) for p in chosen]
    noises = [measure.of(p["references"][run.kind]) for p in chosen]
    if any(v is None for v in values):
        return None
    noise = None if any(n is None for n in noises) else sum(n for n in noises if n is not None) / len(noises)
    return Seen(measure, sum(v for v in values if v is not None) / len(values), noise)


def picture_error(run: Run, fit: str, key: str) -> Estimate:
    """Mean over the run's pictures of ``mse`` or ``relative_mse``."""
    return mean_of([estimate(p["fits"][fit]["errors"][run.kind][key]) for p in run.pictures])


def _errors(runs: Sequence[Run]) -> Table:
    columns = [
        Column("material", "material"),
        Column("method", "method"),
        Column("unexplained variance [%]", "unexplained", 100.0, second="se"),
        Column("MSE [10⁻³/sr²]", "mse", 1e3, second="se"),
        Column("MSE less the first method’s [10⁻³/sr²]", "mse_less_first", 1e3, second="se"),
        Column("PSNR of pictures", "psnr", second="se"),
        Column("relative MSE of pictures", "relative_mse", second="se"),
        *visible_columns(),
        Column("training [s]", "training_seconds", digits=".0f"),
        Column("network weights", "network_weights"),
    ]
    rows: list[list[Cell]] = []
    for run in runs:
        for fit in run.fits:
            mse = picture_error(run, fit, "mse")
            rows.append(
                [
                    name_of(run.material),
                    fit,
                    estimate(run.test(fit)["unexplained"]),
                    run.mse(fit),
                    run.less_first(fit),
                    Decibel.of(mse, run.comparison["white"]),
                    picture_error(run, fit, "relative_mse"),
                    *(mean_seen(run, fit, m) for m in MEASURES),
                    float(run.size(fit)["training_seconds"]),
                    int(run.size(fit)["network_weights"]),
                ]
            )
    for title, _, _ in NOT_HERE.values():
        rows.append(["all", title, NOT_BUILT, *([None] * (len(columns) - 3))])
    text = (
        "Unexplained variance and MSE on the same test queries of each material, which no training saw; "
        "the other measures on the same path-traced pictures, means over the pictures. MSE, relative MSE "
        "and PSNR are free of the reference’s noise; FLIP, SSIM and ST-LPIPS are not, and say so where "
        "noise alone gives as much. Differences are query by query; where one lies below two error bars, "
        "the two methods are not told apart."
    )
    return Table("methods", "Method comparison", text, columns, rows, figures=_figures(runs))


def _figures(runs: Sequence[Run]) -> list[tuple[str, list[Figure]]]:
    """The last picture of every run: reference and fits."""
    out = []
    for run in runs:
        shown = run.pictures[-1]
        row = [Figure(picture(run.picture(shown["references"][run.kind]["file"])), "reference")]
        for fit in run.fits:
            made = shown["fits"][fit]
            psnr = made["errors"][run.kind]["psnr"]["value"]
            line = "" if psnr is None else f"{psnr:.1f} dB".replace("-", "−")
            row.append(Figure(picture(run.picture(made["file"])), fit, [line]))
        out.append((name_of(run.material), row))
    return out


def _ratios(runs: Sequence[Run]) -> Table:
    columns = [
        Column("material", "material"),
        Column("method", "method"),
        Column("over", "over"),
        Column("MSE ratio, measured here", "measured", second="se"),
        Column("MSE ratio, published, of a paper’s own material of this name", "published"),
        Column("source", "source"),
    ]
    rows: list[list[Cell]] = []
    for run in runs:
        pairs = [
            (fit, base) for base in run.fits for fit in run.fits if run.fits.index(fit) > run.fits.index(base)
        ]
        for fit, base in pairs:
            known = mse_ratio(run.material, fit, base)
            measured = ratio_of(run.mse(fit), run.mse(base))
            rows.append(
                [
                    name_of(run.material),
                    fit,
                    base,
                    measured,
                    None if known is None else known.ratio,
                    None if known is None else known.source,
                ]
            )
        for method, (title, _, _) in NOT_HERE.items():
            known = mse_ratio(run.material, method, "neumip")
            if known is not None:
                rows.append([name_of(run.material), title, "neumip", NOT_BUILT, known.ratio, known.source])
    text = (
        "Below 1 the method is better than the one that it is divided by. Published numbers belong to "
        "other data: another material of the same name, other light, other training. Errors of the two "
        "MSEs are taken as independent, which makes the bars rather too wide."
    )
    return Table("ratios", "Ratios beside published ones", text, columns, rows)

"""Tables of a paper: errors by method, level of detail and ablation; time of an evaluation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import combinations

from mbtf_core.stats import Estimate, psnr, ratio_of
from mbtf_pipeline.collection.finished_run import MATERIAL, METHOD, FinishedRun, each_fit, mean_of
from mbtf_pipeline.collection.recipes import Published, first_known
from mbtf_pipeline.compare.perceptual_metrics import PERCEPTUAL_METRICS, PerceptualMetric
from mbtf_pipeline.report.plots import points
from mbtf_pipeline.tables import Cell, Column, Shown, Table, Thumbnail, decibel, estimate, rows_of, signed


def _metric_column(metric: PerceptualMetric) -> Column:
    """Mean of a metric over the images."""

    def mean(run: FinishedRun, fit: str) -> Shown | None:
        values = [metric.of(p["fits"][fit]) for p in run.pictures]
        noises = [metric.of(p["references"][run.kind]) for p in run.pictures]
        known, quiet = ([x for x in found if x is not None] for found in (values, noises))
        if len(known) < len(values):
            return None
        value = sum(known) / len(known)
        noise = sum(quiet) / len(quiet) if len(quiet) == len(values) else None
        return Shown(metric.text(value, noise, with_noise=False), value, noise, "noise")

    return Column(metric.title, metric.key.replace(".", "_"), mean)


def _recorded(title: str, key: str, digits: str = ".3g") -> Column:
    """A number of a fit's record."""
    return Column(title, key, lambda run, fit, *_: run.fit(fit)[key], digits=digits)


_METRICS = [_metric_column(m) for m in PERCEPTUAL_METRICS]


def _picture_error(run: FinishedRun, fit: str, *, key: str = "mse") -> Estimate:
    """Mean over images of ``mse`` or ``relative_mse``."""
    return mean_of([estimate(p["fits"][fit]["errors"][run.kind][key]) for p in run.pictures])


def _psnr(run: FinishedRun, fit: str) -> Shown:
    """PSNR in dB of the mean noise-free MSE of images, with white as peak."""
    mse = _picture_error(run, fit)
    found = psnr(mse, run.comparison["white"])
    return Shown(decibel(found, mse), found.value, found.error, "se")


_UNEXPLAINED = Column("unexplained variance", "unexplained", lambda run, fit: run.error(fit, "unexplained"))
_METHODS = [
    MATERIAL,
    METHOD,
    _UNEXPLAINED,
    Column("MSE [10⁻³/sr²]", "mse", FinishedRun.error, 1e3),
    Column("MSE − MSE of the first method [10⁻³/sr²]", "mse_minus_first", FinishedRun.minus_first, 1e3),
    Column("PSNR of images", "psnr", _psnr),
    Column("relative MSE of images", "relative_mse", partial(_picture_error, key="relative_mse")),
    *_METRICS,
    _recorded("training [s]", "training_seconds", ".0f"),
    _recorded("training steps", "training_steps"),
    _recorded("network weights", "network_weights"),
]


def methods(runs: Sequence[FinishedRun], published: Sequence[Published]) -> list[Table]:
    """Errors of every method on every material, and ratios of MSE beside published ones."""
    rows = rows_of(_METHODS, each_fit(runs))
    images = [(run.title, _last_image(run)) for run in runs]
    errors = Table("methods", "Comparison of methods", _METHODS, rows, images=images)
    columns = [
        MATERIAL,
        METHOD,
        Column("relative to", "relative_to"),
        Column("MSE ratio, measured here", "measured"),
        Column("MSE ratio, published for another material of the same name or kind", "published"),
        Column("source", "source"),
    ]
    ratios: list[list[Cell]] = []
    for run in runs:
        for base, fit in combinations(run.fits, 2):
            known = first_known(published, lambda p: p.mse_ratio(run.material, fit, base))  # noqa: B023
            ratios.append([run.title, fit, base, ratio_of(run.error(fit), run.error(base)), *known])
    return [errors, Table("ratios", "MSE ratios beside published ones", columns, ratios)]


def _last_image(run: FinishedRun) -> list[Thumbnail]:
    """The last image of a run: reference and fits."""
    shown = run.pictures[-1]
    row = [run.preview(shown["references"][run.kind]["file"], "reference")]
    for fit in run.fits:
        record = shown["fits"][fit]
        found = record["errors"][run.kind]["psnr"]["value"]
        line = "" if found is None else signed(f"{found:.1f} dB")
        row.append(run.preview(record["file"], fit, line))
    return row


def levels(runs: Sequence[FinishedRun], published: Sequence[Published]) -> list[Table]:
    """MSE at every level, and relative to the finest, beside published ratios."""
    tests = [run.fit(run.fits[0])["splits"]["test"] for run in runs]
    names = sorted({int(level) for test in tests for level in test["levels"]})

    def column(level: int) -> Column:
        return Column(f"level {level}", f"mse_level_{level}", lambda r, f: r.error_at(f, level), 1e3)

    def mean_at(fit: str, level: int) -> tuple[float, float] | None:
        found = [run.error_at(fit, level, "unexplained") for run in runs if fit in run.fits]
        known = [e for e in found if e is not None]
        return (mean_of(known).value, mean_of(known).error) if known else None

    columns = [MATERIAL, METHOD, *map(column, names)]
    fits = dict.fromkeys(fit for _, fit in each_fit(runs))
    svg = points(
        [str(n) for n in names],
        {fit: [mean_at(fit, n) for n in names] for fit in fits},
        "level of detail",
        "unexplained variance",
        "unexplained variance by level of detail",
    )
    plots = [{"title": f"Mean over {len(runs)} materials", "svg": svg}]
    title = f"Errors at {len(names)} levels of detail"
    errors = Table("levels", title, columns, rows_of(columns, each_fit(runs)), plots)
    return [errors, _level_ratios(runs, names[::-1], published)]


def _level_ratios(
    runs: Sequence[FinishedRun], finest_first: list[int], published: Sequence[Published]
) -> Table:
    zooms = [Column(f"zoom {k}", f"ratio_zoom_{k}") for k in range(len(finest_first))]
    rows: list[list[Cell]] = []
    for run, fit in each_fit(runs):
        first, *others = (run.error_at(fit, n) for n in finest_first)
        if first is None:
            continue
        cells = [None if e is None else ratio_of(e, first) for e in others]
        rows.append([run.title, fit, "measured here", 1.0, *cells])
        known, source = first_known(published, lambda p: p.level_ratios(run.material, fit))  # noqa: B023
        if known is not None:
            ratios = [*known, *[None] * len(finest_first)][: len(finest_first)]
            rows.append([run.title, fit, f"published, {source}", *ratios])
    columns = [MATERIAL, METHOD, Column("source", "source"), *zooms]
    return Table("level_ratios", "Errors relative to the finest level", columns, rows)


def ablations(runs: Sequence[FinishedRun], published: Sequence[Published]) -> list[Table]:
    """Every fit of every variant against the first fit of the first variant of its material."""
    firsts = {run.material: run for run in reversed(runs)}

    def label(run: FinishedRun, fit: str) -> str:
        return fit if len(run.fits) > 1 or not run.variant else run.variant

    def density(run: FinishedRun, fit: str) -> float:
        return float(run.manifest["splits"]["train"]["queries"] / run.texels)

    def difference(run: FinishedRun, fit: str) -> Cell:
        first = firsts[run.material]
        if run is first:
            return run.minus_first(fit)
        mse, base = run.error(fit), first.error(first.fits[0])
        return Estimate(mse.value - base.value, math.hypot(mse.error, base.error), min(mse.n, base.n))

    columns = [
        MATERIAL,
        Column("variant", "variant", label),
        _recorded("network weights", "network_weights"),
        _recorded("texture values", "texels"),
        Column("queries per texel", "queries_per_texel", density, digits=".0f"),
        _UNEXPLAINED,
        Column("MSE − MSE of the first [10⁻³/sr²]", "minus_first", difference, 1e3),
        _recorded("training [s]", "training_seconds", ".0f"),
        _recorded("training steps", "training_steps"),
    ]
    return [Table("ablations", "Ablations", columns, rows_of(columns, each_fit(runs)))]


def timing(runs: Sequence[FinishedRun], published: Sequence[Published]) -> list[Table]:
    """Milliseconds of one evaluation of 1080p, in total and by stage."""
    items = [
        (fit, record)
        for run in runs
        for fit, records in run.comparison.get("timing", {}).items()
        for record in records
    ]

    def milliseconds(title: str, key: str) -> Column:
        return Column(title, f"{key}_ms", lambda fit, record: record[f"{key}_ms"], digits=",.1f")

    def of_lights(n: str) -> Column:
        title = f"{n} light{'s' * (n != '1')}"
        return Column(title, f"lights_{n}_ms", lambda fit, record: record["lights_ms"][n], digits=",.1f")

    lights = items[-1][1]["lights_ms"] if items else ()
    columns = [
        Column("method", "method", lambda fit, record: fit),
        Column("device", "device", lambda fit, record: record["device"]),
        milliseconds("material evaluation", "evaluate"),
        milliseconds("stage 1 (per view)", "stage1"),
        milliseconds("stage 2 (per light): decoder", "stage2"),
        *map(of_lights, lights),
        Column("timed queries", "queries", lambda fit, record: record["queries"]),
    ]
    return [Table("timing", "Time of one evaluation of 1080p", columns, rows_of(columns, items))]

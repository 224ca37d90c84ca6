"""The plots of a study's page, each also as PNG beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost_study.fit_runs import PRESET
from mbtf_pipeline.cost_study.measurements import Measurement
from mbtf_pipeline.cost_study.pareto import pareto_front
from mbtf_pipeline.report.plots import Cloud, scatter

NOISE_AXIS = "RMS error relative to the mean value"
ERROR_AXIS = "unexplained variance of test queries"
TIME_AXIS = "seconds per million queries"
_RUNS = {"whole": "whole runs", "models": "models and sizes", "data": "queries or paths"}

Value = Callable[[Measurement], Estimate]


def is_significant(bias: Estimate | None) -> bool:
    """Whether a bias differs from zero by more than two standard errors."""
    return bias is not None and bias.value > 2 * bias.error


def _figure(
    clouds: Sequence[Cloud], x: str, y: str, name: str, folder: Path, caption: str = "", **options: Any
) -> dict[str, Any]:
    shown = [c for c in clouds if len(c.x)]
    if not shown:
        return {"svg": "", "caption": f"No {y} could be measured."}
    svg = scatter(shown, x, y, f"cost {name}", png=folder / f"{name}.png", **options)
    return {"svg": svg, "caption": caption}


def _cloud(
    name: str,
    found: Sequence[Measurement],
    y: Value = attrgetter("error"),
    x: Value = attrgetter("seconds"),
    *,
    label: Callable[[Measurement], str] = attrgetter("name"),
    joined: bool = True,
    hollow: bool = False,
) -> Cloud:
    usable = [m for m in found if math.isfinite(y(m).value) and math.isfinite(x(m).value)]
    ordered = sorted(usable, key=lambda m: x(m).value)
    xs, ys = ([of(m).value for m in ordered] for of in (x, y))
    dx, dy = ([e if math.isfinite(e := of(m).error) else 0.0 for m in ordered] for of in (x, y))
    return Cloud(name, xs, ys, dx, dy, [label(m) for m in ordered], joined=joined, hollow=hollow)


def _by_series(found: Sequence[Measurement], **options: Any) -> list[Cloud]:
    names = list(dict.fromkeys(m.series for m in found))
    return [_cloud(n, [m for m in found if m.series == n], **options) for n in names]


def noise_figures(found: Sequence[Measurement], name: str, folder: Path) -> list[dict[str, Any]]:
    """Noise over seconds, one line per series."""
    return [_figure(_by_series(found), TIME_AXIS, NOISE_AXIS, name, folder)]


def bias_figures(found: Sequence[Measurement], name: str, folder: Path) -> list[dict[str, Any]]:
    """Bias and noise over seconds."""
    biased = [m for m in found if is_significant(m.bias)]
    clouds = [
        _cloud("bias", biased, lambda m: m.bias or m.error, joined=False),
        _cloud(
            "noise",
            found,
            lambda m: m.noise or m.error,
            label=lambda m: "" if is_significant(m.bias) else m.name,
            joined=False,
            hollow=True,
        ),
    ]
    limits = [2 * max(m.bias.error, m.bias.value) for m in found if m.bias and not is_significant(m.bias)]
    caption = ""
    if limits:
        limit = 100 * max(limits)
        caption = (
            f"Labels at the noise: the bias is not significant, at most {limit:.2g} % of the mean value."
        )
    return [_figure(clouds, TIME_AXIS, NOISE_AXIS, name, folder, caption)]


def data_figures(found: Sequence[Measurement], name: str, folder: Path) -> list[dict[str, Any]]:
    """Error over seconds of generating."""
    return [_figure(_by_series(found), "seconds of generating", ERROR_AXIS, name, folder)]


def model_figures(found: Sequence[Measurement], name: str, folder: Path) -> list[dict[str, Any]]:
    """Error over seconds of training, and over milliseconds of evaluation."""
    series = dict.fromkeys(m.series for m in found)
    longest = [max((m for m in found if m.series == s), key=lambda m: m.seconds.value) for s in series]
    evaluated = _by_series(
        longest,
        x=lambda m: Estimate(m.details.get("evaluation_ms_1080p", math.nan), 0.0, 1),
        label=lambda m: m.series.removeprefix("neumip, "),
        joined=False,
    )
    axis = "milliseconds for a 1080p image, one query per pixel"
    caption = "The longest training of each."
    return [
        _figure(_by_series(found), "seconds of training", ERROR_AXIS, name, folder),
        _figure(evaluated, axis, ERROR_AXIS, f"{name}_evaluation", folder, caption),
    ]


def run_name(m: Measurement) -> str:
    """Queries × paths, and the model where it is not that of the presets."""
    name = f"{m.details['queries'] / 1e6:.2g} M × {m.details['spp']:g}"
    if m.study != "models" or m.series == PRESET:
        return name
    return f"{name}, {m.series.partition(', ')[2] or f'{m.series} of its paper'}"


def front_figures(runs: Sequence[Measurement], folder: Path) -> list[dict[str, Any]]:
    """All runs and their Pareto front, whose points have names."""
    front = pareto_front(runs)
    clouds = [
        _cloud(
            title,
            [m for m in runs if m.study == study],
            label=lambda m: run_name(m) if m in front else "",
            joined=False,
        )
        for study, title in _RUNS.items()
    ]
    axis = "seconds in total, from height map to material"
    caption = "Names on the front: training queries × paths per query, and models other than the preset's."
    points = [(m.seconds.value, m.error.value) for m in front]
    return [_figure(clouds, axis, ERROR_AXIS, "front", folder, caption, front=points)]

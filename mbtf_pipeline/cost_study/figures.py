"""The plots of a study's page, each also as PNG beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost_study.fit_runs import QUALITIES
from mbtf_pipeline.cost_study.measurements import Point
from mbtf_pipeline.cost_study.pareto import pareto_front
from mbtf_pipeline.report.plots import Cloud, scatter

NOISE_AXIS = "RMS error relative to the mean value"
ERROR_AXIS = "unexplained variance of test queries"
PRICE_AXIS = "seconds per million queries"


def told(point: Point) -> bool:
    """Whether a bias is told from zero."""
    return point.bias is not None and point.bias.value > 2 * point.bias.error


def _figure(
    clouds: Sequence[Cloud], x: str, y: str, name: str, folder: Path, caption: str = "", **options: Any
) -> dict[str, Any]:
    shown = [c for c in clouds if len(c.x)]
    if not shown:
        return {"svg": "", "caption": f"No {y} could be told."}
    svg = scatter(shown, x, y, f"cost {name}", png=folder / f"{name}.png", **options)
    return {"svg": svg, "caption": caption}


def _cloud(
    name: str,
    points: Sequence[Point],
    y: Callable[[Point], Estimate],
    x: Callable[[Point], Estimate] = lambda p: p.seconds,
    *,
    label: Callable[[Point], str] = lambda p: p.name,
    joined: bool = True,
    hollow: bool = False,
) -> Cloud:
    usable = [p for p in points if math.isfinite(y(p).value) and math.isfinite(x(p).value)]
    ordered = sorted(usable, key=lambda p: x(p).value)

    def bars(of: Callable[[Point], Estimate]) -> list[float]:
        return [of(p).error if math.isfinite(of(p).error) else 0.0 for p in ordered]

    return Cloud(
        name,
        [x(p).value for p in ordered],
        [y(p).value for p in ordered],
        bars(x),
        bars(y),
        [label(p) for p in ordered],
        joined=joined,
        hollow=hollow,
    )


def _by_series(
    points: Sequence[Point],
    y: Callable[[Point], Estimate],
    x: Callable[[Point], Estimate] = lambda p: p.seconds,
    *,
    label: Callable[[Point], str] = lambda p: p.name,
    joined: bool = True,
) -> list[Cloud]:
    names = list(dict.fromkeys(p.series for p in points))
    return [_cloud(n, [p for p in points if p.series == n], y, x, label=label, joined=joined) for n in names]


def _error(point: Point) -> Estimate:
    return point.error


def detail(name: str) -> Callable[[Point], Estimate]:
    """A further number of a point, with its standard error where there is one; NaN where there is none."""

    def of(point: Point) -> Estimate:
        return Estimate(point.details.get(name, math.nan), point.details.get(f"{name}_se", 0.0), 1)

    return of


def noise_figures(points: Sequence[Point], name: str, folder: Path) -> list[dict[str, Any]]:
    """Noise over seconds, one line per series."""
    return [_figure(_by_series(points, _error), PRICE_AXIS, NOISE_AXIS, name, folder)]


def count_figures(points: Sequence[Point], name: str, folder: Path) -> list[dict[str, Any]]:
    """Noise over seconds for ways to count paths, by both measures of it."""
    relative = _by_series(points, detail("relative"))
    return [
        _figure(
            _by_series(points, _error), PRICE_AXIS, NOISE_AXIS, name, folder, "Relative to the mean value."
        ),
        _figure(
            relative,
            PRICE_AXIS,
            "RMS of error ÷ max(value, tile mean)",
            f"{name}_relative",
            folder,
            "Relative to each value, or to the tile mean where that is more: what a target error is about.",
        ),
    ]


def bias_figures(points: Sequence[Point], name: str, folder: Path) -> list[dict[str, Any]]:
    """Bias and noise over seconds, apart."""
    hidden = [p for p in points if not told(p)]
    clouds = [
        _cloud("bias", [p for p in points if told(p)], lambda p: p.bias or p.error, joined=False),
        _cloud(
            "noise",
            points,
            lambda p: p.noise or p.error,
            label=lambda p: "" if told(p) else p.name,
            joined=False,
            hollow=True,
        ),
    ]
    caption = ""
    if hidden:
        limits = [2 * max(p.bias.error, p.bias.value) for p in hidden if p.bias is not None]
        caption = "Settings named at their noise have a bias that is not told from zero" + (
            f", at most {100 * max(limits):.2g} % of the mean value." if limits else "."
        )
    return [_figure(clouds, PRICE_AXIS, NOISE_AXIS, name, folder, caption)]


def data_figures(points: Sequence[Point], name: str, folder: Path) -> list[dict[str, Any]]:
    """Error over seconds of generating."""
    return [_figure(_by_series(points, _error), "seconds of generating", ERROR_AXIS, name, folder)]


def fit_figures(points: Sequence[Point], name: str, folder: Path) -> list[dict[str, Any]]:
    """Error over seconds of training, milliseconds of evaluation and bytes, the last in both precisions."""
    longest = [
        max((p for p in points if p.series == s), key=lambda p: p.seconds.value)
        for s in dict.fromkeys(p.series for p in points)
    ]
    half = [replace(p, error=_half_error(p)) for p in longest]

    def series(p: Point) -> str:
        return "of the qualities" if p.series == QUALITIES else p.series.removeprefix("neumip, ")

    def precise(kind: str, some: Sequence[Point], size: str, hollow: bool) -> Cloud:
        def kilobytes(p: Point) -> Estimate:
            return detail(size)(p).scaled(1e-3)

        return _cloud(kind, some, _error, kilobytes, label=series, joined=False, hollow=hollow)

    return [
        _figure(_by_series(points, _error), "seconds of training", ERROR_AXIS, name, folder),
        _figure(
            _by_series(longest, _error, detail("evaluation_ms_1080p"), label=series, joined=False),
            "milliseconds for a 1080p picture, one query per pixel",
            ERROR_AXIS,
            f"{name}_evaluation",
            folder,
            "The longest training of each.",
        ),
        _figure(
            [
                precise("32-bit floats", longest, "bytes", False),
                precise("the same in 16-bit floats", half, "half_bytes", True),
            ],
            "kilobytes of the material",
            ERROR_AXIS,
            f"{name}_bytes",
            folder,
            "The longest training of each, as it is and rounded to half precision.",
        ),
    ]


def _half_error(point: Point) -> Estimate:
    """Error in half precision; its bar is that of single precision, whose test queries and seed it shares."""
    return Estimate(point.details.get("half_error", math.nan), point.error.error, point.error.n)


_STUDIES = {"chain": "whole chains", "data": "queries or paths", "fit": "models and sizes"}


def chain_name(point: Point) -> str:
    """Queries × paths, and what sets the fit apart from that of the qualities."""
    name = f"{point.details['queries'] / 1e6:.2g} M × {point.details['spp']:g}"
    if point.study != "fit" or point.series == QUALITIES:
        return name
    return f"{name}, {point.series.partition(', ')[2] or f'{point.series} of its paper'}"


def front_figures(chains: Sequence[Point], folder: Path) -> list[dict[str, Any]]:
    """All chains and the front; only the front's points have names."""
    front = pareto_front(chains)
    named = {id(p) for p in front}
    clouds = [
        _cloud(
            title,
            [p for p in chains if p.study == study],
            _error,
            label=lambda p: chain_name(p) if id(p) in named else "",
            joined=False,
        )
        for study, title in _STUDIES.items()
    ]
    return [
        _figure(
            clouds,
            "seconds in all, from height map to material",
            ERROR_AXIS,
            "front",
            folder,
            "Names on the front: training queries × paths per query, and fits unlike those of the qualities.",
            front=[(p.seconds.value, p.error.value) for p in front],
        )
    ]

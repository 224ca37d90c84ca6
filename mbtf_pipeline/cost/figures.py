"""The plots of a study's page, each also as PNG beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost.measurements import Measurement
from mbtf_pipeline.cost.pareto import pareto_front
from mbtf_pipeline.report.plots import Cloud, scatter
from mbtf_pipeline.tables import is_significant

NOISE_AXIS = "RMS error relative to the mean value"
ERROR_AXIS = "unexplained variance of test queries"
TIME_AXIS = "seconds per million queries"

Value = Callable[[Measurement], Estimate]
# Figures of measurements, also written to this PNG and others beside it.
Figures = Callable[[Sequence[Measurement], Path], list[dict[str, Any]]]


def _figure(
    clouds: Sequence[Cloud], x: str, y: str, png: Path, caption: str = "", **options: Any
) -> dict[str, Any]:
    shown = [c for c in clouds if len(c.x)]
    if not shown:
        return {"svg": "", "caption": f"No {y} could be measured."}
    return {"svg": scatter(shown, x, y, f"cost {png.stem}", png=png, **options), "caption": caption}


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
    names = dict.fromkeys(m.series for m in found)
    return [_cloud(n, [m for m in found if m.series == n], **options) for n in names]


def lines(x: str, y: str) -> Figures:
    """Error over seconds, one line per series; axes with these titles."""
    return lambda found, png: [_figure(_by_series(found), x, y, png)]


def bias_figures(found: Sequence[Measurement], png: Path) -> list[dict[str, Any]]:
    """Bias and noise over seconds."""
    biased = [m for m in found if m.bias and is_significant(m.bias)]
    unbiased = [m for m in found if m not in biased]
    clouds = [
        _cloud("bias", biased, attrgetter("bias"), joined=False),
        _cloud(
            "noise",
            found,
            attrgetter("noise"),
            label=lambda m: m.name if m in unbiased else "",
            joined=False,
            hollow=True,
        ),
    ]
    limit = 100 * max((2 * max(m.bias.error, m.bias.value) for m in unbiased if m.bias), default=0.0)
    caption = f"Labels at the noise: the bias is not significant, at most {limit:.2g} % of the mean value."
    return [_figure(clouds, TIME_AXIS, NOISE_AXIS, png, caption if unbiased else "")]


def front_figures(runs: Sequence[Measurement], png: Path) -> list[dict[str, Any]]:
    """All runs and their Pareto front, whose points have names: training queries × paths per query."""
    front = pareto_front(runs)

    def name(m: Measurement) -> str:
        return f"{m.details['queries'] / 1e6:.2g} M × {m.details['spp']:g}" if m in front else ""

    cloud = _cloud("complete runs", runs, label=name, joined=False)
    axis = "seconds in total, from height map to material"
    caption = "Names on the front: training queries × paths per query."
    points = [(m.seconds.value, m.error.value) for m in front]
    return [_figure([cloud], axis, ERROR_AXIS, png, caption, front=points)]

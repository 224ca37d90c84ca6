"""Plots of the report as SVG text that takes the page's color and font."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.atomic import write_through
from mbtf_pipeline.report.labels import Named, place_names

# Okabe and Ito (2008), gray in place of black, without yellow: told apart under every common color-vision
# deficiency.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
# Stands for the page's own text color until the SVG is inlined.
_INK = "#010203"
# A logarithmic axis ends at most this factor below its smallest value and above its largest.
_REACH = 2.0
BARS_NOTE = (
    "Bars and bands are one standard error. What lies below half the smallest positive value of a plot or "
    "above twice the largest is cut off there: a logarithmic axis has no zero."
)
_WIDTH = 5.6
_HEIGHT = 3.3


def color(index: int) -> str:
    """Color of the fit with the given number."""
    return COLORS[index % len(COLORS)]


@dataclass(frozen=True)
class Cloud:
    """A named set of points: x, y and names (n,), and standard errors of both (n,)."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    x_error: Sequence[float]
    y_error: Sequence[float]
    labels: Sequence[str]
    joined: bool = True
    hollow: bool = False


@dataclass(frozen=True)
class Curve:
    """A named line: x and y (n,), and optionally the standard error of y (n,)."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    error: Sequence[float] | None = None


# In place of the user's own matplotlib settings.
_STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": _INK,
    "axes.edgecolor": _INK,
    "axes.labelcolor": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


@contextlib.contextmanager
def _style(label: str) -> Iterator[None]:
    """Matplotlib's settings while a plot is drawn; with the label as salt its ids do not vary."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update({**_STYLE, "svg.hashsalt": label})
        yield


def _figure(width: float = _WIDTH, height: float = _HEIGHT) -> Any:
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasSVG(figure)
    figure.patch.set_alpha(0.0)
    return figure


def _svg(figure: Any, label: str) -> str:
    """The figure as an ``<svg>`` element whose ids are its own on the page."""
    stream = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Type", "Format"))
    figure.savefig(stream, format="svg", transparent=True, metadata=nothing)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    prefix = re.sub(r"[^A-Za-z0-9]+", "-", label)
    text = re.sub(r'\bid="([^"]+)"', rf'id="{prefix}-\1"', text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{prefix}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{prefix}-\1)", text)
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r"font: ([\d.]+px) [^;\"]*", r"font-size: \1", text)
    return text.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1).replace(_INK, "currentColor")


def _axes(figure: Any, x: str, y: str, *, logx: bool = False, logy: bool = False) -> Any:
    axes = figure.add_subplot()
    axes.patch.set_alpha(0.0)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    if logx:
        axes.set_xscale("log")
    if logy:
        axes.set_yscale("log")
    axes.grid(True, which="major", color=_INK, alpha=0.12, linewidth=0.6)
    return axes


def curves(
    lines: Sequence[Curve], x: str, y: str, label: str, *, logx: bool = False, logy: bool = True
) -> str:
    """Lines with bands of one standard error; axes named with units."""
    with _style(label):
        return _svg(_curves(lines, x, y, logx, logy), label)


def _curves(lines: Sequence[Curve], x: str, y: str, logx: bool, logy: bool) -> Any:
    figure = _figure()
    axes = _axes(figure, x, y, logx=logx, logy=logy)
    low, high = _ends([v for line in lines for v in line.y]) if logy else (-np.inf, np.inf)
    shown: list[float] = []
    for index, line in enumerate(lines):
        xs, values = np.asarray(line.x, float), np.asarray(line.y, float)
        ys = np.clip(values, low, high)
        axes.plot(xs, ys, color=color(index), linewidth=1.7, label=line.name)
        shown += [ys.min(), ys.max()]
        if line.error is not None:
            e = np.asarray(line.error, float)
            below, above = (np.clip(values + side, low, high) for side in (-e, e))
            axes.fill_between(xs, below, above, color=color(index), alpha=0.18, linewidth=0)
            shown += [below.min(), above.max()]
    if logy:
        axes.set_ylim(max(low, min(shown) / 1.05), min(high, max(shown) * 1.05))
        _plain_ticks(axes.yaxis)
    if logx:
        _plain_ticks(axes.xaxis)
    axes.legend(frameon=False)
    return figure


def _ends(values: Sequence[float]) -> tuple[float, float]:
    """How far a logarithmic axis may reach for these values, of which those above zero count."""
    positive = [v for v in values if v > 0]
    return (min(positive) / _REACH, max(positive) * _REACH) if positive else (0.1, 1.0)


def scatter(
    clouds: Sequence[Cloud],
    x: str,
    y: str,
    label: str,
    *,
    front: Sequence[tuple[float, float]] = (),
    png: Path | None = None,
) -> str:
    """Points with error bars on logarithmic axes, each with its name, and a front as a stepped line.

    Parameters
    ----------
    png : also written there, on white
    """
    with _style(label):
        figure = _scatter(clouds, x, y, front)
        if png is not None:
            _write_png(figure, png)
        return _svg(figure, label)


def _write_png(figure: Any, path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.patch.set_alpha(1.0)
    write_through(
        path,
        lambda temporary: FigureCanvasAgg(figure).figure.savefig(
            temporary, format="png", dpi=160, facecolor="white", metadata={"Software": None}
        ),
    )
    figure.patch.set_alpha(0.0)


def _scatter(clouds: Sequence[Cloud], x: str, y: str, front: Sequence[tuple[float, float]]) -> Any:
    figure = _figure(7.2, 4.2)
    axes = _axes(figure, x, y, logx=True, logy=True)
    floor = _ends([v for cloud in clouds for v in cloud.y])[0]
    shown: list[tuple[float, float]] = []
    named: list[Named] = []
    lines: list[tuple[tuple[float, float], tuple[float, float]]] = []
    handles = []
    for index, cloud in enumerate(clouds):
        xs, ys = np.asarray(cloud.x, float), np.maximum(np.asarray(cloud.y, float), floor)
        across = np.minimum(np.asarray(cloud.x_error, float), 0.95 * xs)
        upright = np.minimum(np.asarray(cloud.y_error, float), 0.95 * ys)
        drawn = axes.errorbar(
            xs,
            ys,
            xerr=across,
            yerr=upright,
            fmt=MARKERS[index % len(MARKERS)],
            color=color(index),
            markerfacecolor="none" if cloud.hollow else color(index),
            markersize=6,
            capsize=2.5,
            linewidth=1.1,
        )
        handles.append((drawn.lines[0], cloud.name))
        if cloud.joined:
            axes.plot(xs, ys, color=color(index), linewidth=0.8, alpha=0.5)
        for at_x, at_y, dx, dy in zip(xs, ys, across, upright, strict=True):
            lines += [((at_x - dx, at_y), (at_x + dx, at_y)), ((at_x, at_y - dy), (at_x, at_y + dy))]
        shown += list(zip(xs, ys, strict=True))
        named += [
            Named(at_x, at_y, text, color(index))
            for at_x, at_y, text in zip(xs, ys, cloud.labels, strict=True)
            if text
        ]
    if front:
        fx, fy = np.asarray(front, float).T
        drawn = axes.step(fx, fy, where="post", color=_INK, linewidth=1.3, linestyle=(0, (4, 2)))
        handles.append((drawn[0], "Pareto front"))
        for (x0, y0), (x1, y1) in pairwise(front):
            lines += [((x0, y0), (x1, y0)), ((x1, y0), (x1, y1))]
    axes.margins(y=0.1)
    # Room for names on either side.
    left, right = axes.get_xlim()
    reach = right / left
    axes.set_xlim(left / reach**0.06, right * reach**0.2)
    for axis in (axes.xaxis, axes.yaxis):
        _plain_ticks(axis)
    _legend_above(figure, handles)
    place_names(figure, axes, named, shown, lines)
    return figure


def points(
    groups: Sequence[str],
    series: Mapping[str, Sequence[tuple[float, float] | None]],
    x: str,
    y: str,
    label: str,
) -> str:
    """Values with error bars for named groups along x, one series per fit; None leaves a point out."""
    with _style(label):
        return _svg(_points(groups, series, x, y), label)


def _points(
    groups: Sequence[str], series: Mapping[str, Sequence[tuple[float, float] | None]], x: str, y: str
) -> Any:
    figure = _figure()
    axes = _axes(figure, x, y, logy=True)
    spread = 0.16
    for index, (name, values) in enumerate(series.items()):
        shift = (index - (len(series) - 1) / 2) * spread
        shown = [(g + shift, *v) for g, v in enumerate(values) if v is not None and v[0] > 0]
        if not shown:
            continue
        xs, ys, es = np.asarray(shown, float).T
        es = np.minimum(es, 0.95 * ys)
        axes.errorbar(
            xs,
            ys,
            yerr=es,
            fmt=MARKERS[index % len(MARKERS)],
            color=color(index),
            markersize=5,
            capsize=2.5,
            linewidth=1.2,
            label=name,
        )
        axes.plot(xs, ys, color=color(index), linewidth=0.8, alpha=0.45)
    axes.set_xticks(range(len(groups)), groups)
    axes.set_xlim(-0.6, len(groups) - 0.4)
    # A bar that reaches down to zero has no end on a logarithmic axis: the values set its range.
    axes.set_ylim(*_ends([v[0] for row in series.values() for v in row if v is not None]))
    _plain_ticks(axes.yaxis)
    axes.legend(frameon=False)
    return figure


def _legend_above(figure: Any, handles: Sequence[tuple[Any, str]]) -> None:
    """Legend above the plot, where it hides no point, in as many columns as the figure is wide."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    renderer = FigureCanvasAgg(figure).get_renderer()
    marks, names = zip(*handles, strict=True)
    for columns in (4, 3, 2, 1):
        legend = figure.legend(
            marks, names, loc="outside upper left", frameon=False, fontsize=8.5, ncols=columns
        )
        if columns == 1 or legend.get_window_extent(renderer).width <= figure.bbox.width:
            return
        legend.remove()


def _plain_ticks(axis: Any) -> None:
    """Ticks of a logarithmic axis at 1, 2 and 5 of each decade (fewer or more where it is long or short)."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    decades = float(np.log10(high / low)) if 0 < low < high else 9.0
    subs: tuple[float, ...] = (1.0, 2.0, 5.0) if decades < 2.2 else (1.0,)
    if decades < 0.6:
        subs = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
    if decades < 0.35:
        subs = tuple(np.arange(1.0, 10.0, 0.5))
    axis.set_major_locator(LogLocator(base=10, subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axis.set_minor_formatter(NullFormatter())


def bars(parts: Sequence[tuple[str, float]], x: str, label: str) -> str:
    """Horizontal bars, the first on top, each with its value written beside it."""
    with _style(label):
        return _svg(_bars(parts, x), label)


def _bars(parts: Sequence[tuple[str, float]], x: str) -> Any:
    figure = _figure(_WIDTH, 0.42 * len(parts) + 0.75)
    axes = _axes(figure, x, "")
    names = [name for name, _ in parts]
    values = [value for _, value in parts]
    axes.barh(range(len(parts)), values, color=COLORS[0], height=0.62)
    axes.set_yticks(range(len(parts)), names)
    axes.invert_yaxis()
    axes.grid(False, axis="y")
    axes.set_axisbelow(True)
    axes.set_xlim(0, 1.18 * max([*values, 1e-9]))
    for row, value in enumerate(values):
        axes.annotate(f"{value:.3g}", (value, row), (5, 0), textcoords="offset points", va="center")
    return figure

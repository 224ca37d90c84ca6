"""Plots as SVG elements in the page's text color and font."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.files.atomic import write_through

# Okabe and Ito (2008) with gray instead of black and without yellow: distinguishable under every common
# color-vision deficiency.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
ERROR_BAR_NOTE = (
    "Error bars and bands show one standard error. Logarithmic axes end at half the smallest positive value "
    "and at twice the largest, or show bands up to a tenth and ten times of these."
)
# Placeholder for the page's text color until the SVG is embedded.
_INK = "#010203"
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


@dataclass(frozen=True)
class Series:
    """A named series of a plot.

    Attributes
    ----------
    x, y : (n,); x_error, y_error : their standard errors, (n,), or none; those not finite are not drawn
    labels : (n,), one per point, or none
    style : a line with a band, points, or points joined by a line; hollow : whether markers are hollow
    x_error_name : what the legend calls bars along x, if anything
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    y_error: Sequence[float] | None = None
    x_error: Sequence[float] | None = None
    labels: Sequence[str] = ()
    style: Literal["line", "points", "joined"] = "line"
    hollow: bool = False
    x_error_name: str = ""


def plot(
    series: Sequence[Series],
    x: str,
    y: str,
    label: str,
    *,
    log: str = "xy",
    groups: Sequence[str] = (),
    front: Sequence[tuple[float, float]] = (),
    png: Path | None = None,
) -> str:
    """Draw series over axes with these titles.

    Parameters
    ----------
    series : sequence of Series
    x, y : titles of the axes, with units
    label : of the plot, unique on its page
    log : logarithmic axes; y is always one of them
    groups : names of the positions 0, 1, 2, … along x
    front : a Pareto front, drawn as a stepped line
    png : file for a larger plot of the same on white

    Returns
    -------
    str
        An ``<svg>`` element.
    """
    from matplotlib import style
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    # Independent of the user's settings; the label makes the ids reproducible.
    with style.context({**_STYLE, "svg.hashsalt": label}, after_reset=True):
        figure = Figure(figsize=(5.6, 3.3) if png is None else (7.2, 4.2), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.add_subplot()
        axes.patch.set_alpha(0.0)
        axes.set(xlabel=x, ylabel=y, **{f"{axis}scale": "log" for axis in log})
        axes.grid(True, which="major", color=_INK, alpha=0.12, linewidth=0.6)
        low, high = _range(series)
        handles: list[tuple[Any, str]] = []
        for index, one in enumerate(series):
            handles += _draw(axes, index, one, low, high)
        if front:
            step = axes.step(*np.asarray(front, float).T, where="post", color=_INK, lw=1.3, ls=(0, (4, 2)))
            handles.append((step[0], "Pareto front"))
        # The values set the range: an error bar that reaches zero has no end on a logarithmic axis.
        bottom, top = axes.get_ylim()
        axes.set_ylim(max(bottom, low), min(top, high))
        if groups:
            axes.set_xticks(range(len(groups)), groups)
            axes.set_xlim(-0.6, len(groups) - 0.4)
        elif "x" in log:
            _extend(axes)
        for axis in log:
            _plain_ticks(getattr(axes, f"{axis}axis"))
        if handles:
            marks, names = zip(*handles, strict=True)
            figure.legend(marks, names, ncols=2, loc="outside upper left", frameon=False, fontsize=8.5)
        if png is not None:
            options = {"dpi": 160, "facecolor": "white", "metadata": {"Software": None}}
            write_through(png, lambda path: figure.savefig(path, format="png", **options))
        return _svg(figure, label)


def points(
    groups: Sequence[str],
    series: Mapping[str, Sequence[tuple[float, float] | None]],
    x: str,
    y: str,
    label: str,
) -> str:
    """Values with error bars by group, one series per fit; None leaves a point out."""
    shown = []
    for index, (name, values) in enumerate(series.items()):
        shift = 0.16 * (index - (len(series) - 1) / 2)
        known = [(g + shift, *v) for g, v in enumerate(values) if v is not None and v[0] > 0]
        if known:
            xs, ys, errors = zip(*known, strict=True)
            shown.append(Series(name, xs, ys, errors, style="joined"))
    return plot(shown, x, y, label, log="y", groups=groups)


def _range(series: Sequence[Series]) -> tuple[float, float]:
    """Lowest and highest value that a logarithmic y axis may show."""
    positive = [v for one in series for v in one.y if v > 0]
    if not positive:
        return 0.1, 1.0
    low, high = min(positive), max(positive)
    ends = np.concatenate(
        [_bounds(one).ravel() for one in series if one.style == "line" and one.y_error is not None]
        or [np.empty(0)]
    )
    ends = np.clip(ends[ends > 0], 0.1 * low, 10.0 * high)
    return min(low / 2.0, ends.min(initial=low) / 1.1), max(high * 2.0, ends.max(initial=high) * 1.1)


def _bounds(one: Series) -> NDArray[np.float64]:
    """Ends (2, n) of the error bars of a series, below and above."""
    error = np.asarray(one.y_error, float)
    return np.asarray(one.y, float) + np.stack([-error, error])


def _draw(axes: Any, index: int, one: Series, low: float, high: float) -> list[tuple[Any, str]]:
    """Draw a series, its values within the limits of the axis; returns its marks and names for the legend."""
    color = COLORS[index % len(COLORS)]
    x, y = np.asarray(one.x, float), np.clip(np.asarray(one.y, float), low, high)
    if one.style == "line":
        (mark,) = axes.plot(x, y, color=color, linewidth=1.7)
        if one.y_error is not None:
            axes.fill_between(x, *np.clip(_bounds(one), low, high), color=color, alpha=0.18, linewidth=0)
        return [(mark, one.name)]
    x_error, y_error = (
        None if error is None else np.minimum(np.nan_to_num(error, posinf=0.0), 0.95 * values)
        for error, values in ((one.x_error, x), (one.y_error, y))
    )
    marker = {"fmt": MARKERS[index % len(MARKERS)], "markersize": 5.5, "capsize": 2.5, "linewidth": 1.1}
    fill = "none" if one.hollow else color
    drawn = axes.errorbar(x, y, y_error, x_error, color=color, markerfacecolor=fill, **marker)
    if one.style == "joined":
        axes.plot(x, y, color=color, linewidth=0.8, alpha=0.5)
    style = {"textcoords": "offset points", "fontsize": 7.5, "color": color}
    for *at, text in zip(x, y, one.labels, strict=False):
        # Otherwise constrained layout would shrink the axes for the label.
        axes.annotate(text, at, (6, 5), **style).set_in_layout(False)
    marks = [(drawn.lines[0], one.name)]
    if one.x_error_name:
        (bar,) = axes.plot([], [], color=color, linewidth=1.1, marker="|", markersize=5)
        marks.append((bar, one.x_error_name))
    return marks


def _extend(axes: Any) -> None:
    """Extend a logarithmic x axis for labels on the right."""
    left, right = axes.get_xlim()
    if right < 1.01 * left:  # A single time: the limits differ by rounding alone.
        left, right = left / 1.5, right * 1.5
    axes.set_xlim(left / (right / left) ** 0.06, right * (right / left) ** 0.2)


def _plain_ticks(axis: Any) -> None:
    """Ticks of a logarithmic axis at 1, 2 and 5 of each decade, denser for short ranges, sparser for long."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    decades = float(np.log10(high / low)) if 0 < low < high else 9.0
    dense = np.arange(1.0, 10.0, 0.5)
    densities = ((0.35, dense), (1.0, (1, 1.5, 2, 3, 4, 5, 7)), (2.2, (1, 2, 5)), (np.inf, (1,)))
    subs = next(subs for most, subs in densities if decades < most)
    axis.set_major_locator(LogLocator(base=10, subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axis.set_minor_formatter(NullFormatter())


def _svg(figure: Any, label: str) -> str:
    """The figure as an ``<svg>`` element with ids that are unique on the page."""
    stream = io.StringIO()
    metadata = dict.fromkeys(("Date", "Creator", "Type", "Format"))
    figure.savefig(stream, format="svg", transparent=True, metadata=metadata)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    prefix = re.sub(r"[^A-Za-z0-9]+", "-", label)
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{prefix}-", text)
    for side in ("width", "height"):
        text = re.sub(rf'(<svg[^>]*?) {side}="[^"]*"', r"\1", text, count=1)
    text = re.sub(r"font: ([\d.]+px) [^;\"]*", r"font-size: \1", text)
    return text.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1).replace(_INK, "currentColor")

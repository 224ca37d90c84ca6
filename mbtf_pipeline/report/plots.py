"""Plots as SVG elements in the page's text color and font."""

from __future__ import annotations

import contextlib
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.files.atomic import write_through

# Okabe and Ito (2008) with gray instead of black and without yellow: distinguishable under every common
# color-vision deficiency.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
# Placeholder for the page's text color until the SVG is embedded.
_INK = "#010203"
# A logarithmic axis extends at most by this factor beyond the smallest and the largest value.
_REACH = 2.0
ERROR_BAR_NOTE = (
    "Error bars and bands show one standard error. Logarithmic axes end at half the smallest positive value "
    "and at twice the largest."
)
_WIDTH, _HEIGHT = 5.6, 3.3
_LABEL_SIZE = 7.5


def color(index: int) -> str:
    """Color of the series with the given number."""
    return COLORS[index % len(COLORS)]


@dataclass(frozen=True)
class Cloud:
    """A named set of points.

    Attributes
    ----------
    x, y : (n,); x_error, y_error : their standard errors, (n,)
    labels : (n,), one per point; empty for none
    joined : whether a line connects the points; hollow : whether markers are hollow
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    x_error: Sequence[float]
    y_error: Sequence[float]
    labels: Sequence[str]
    joined: bool = True
    hollow: bool = False


@dataclass(frozen=True)
class Line:
    """A named line: x and y (n,), and optionally the standard error of y (n,)."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    error: Sequence[float] | None = None


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


def _style(label: str) -> contextlib.AbstractContextManager[None]:
    """Matplotlib settings independent of the user's; the label makes the ids reproducible."""
    from matplotlib import style

    return style.context({**_STYLE, "svg.hashsalt": label}, after_reset=True)


def _axes(x: str, y: str, scales: str, width: float = _WIDTH, height: float = _HEIGHT) -> Any:
    """Axes of a new figure; `scales` names those that are logarithmic: ``xy``, ``y``, ``x`` or empty."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasSVG(figure)
    figure.patch.set_alpha(0.0)
    axes = figure.add_subplot()
    axes.patch.set_alpha(0.0)
    axes.set(xlabel=x, ylabel=y, **{f"{axis}scale": "log" for axis in scales})
    axes.grid(True, which="major", color=_INK, alpha=0.12, linewidth=0.6)
    return axes


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


def _limits(values: Sequence[float]) -> tuple[float, float]:
    """Range of a logarithmic axis for the positive ones of these values."""
    positive = [v for v in values if v > 0]
    return (min(positive) / _REACH, max(positive) * _REACH) if positive else (0.1, 1.0)


def curves(lines: Sequence[Line], x: str, y: str, label: str, *, scales: str = "y") -> str:
    """Lines with bands of one standard error; `x` and `y` name the axes with units."""
    with _style(label):
        axes = _axes(x, y, scales)
        low, high = _limits([v for line in lines for v in line.y])
        shown: list[float] = []
        for index, line in enumerate(lines):
            values = np.asarray(line.y, float)
            ys = np.clip(values, low, high)
            axes.plot(line.x, ys, color=color(index), linewidth=1.7, label=line.name)
            shown += [ys.min(), ys.max()]
            if line.error is not None:
                e = np.asarray(line.error, float)
                below, above = (np.clip(values + side, low, high) for side in (-e, e))
                axes.fill_between(line.x, below, above, color=color(index), alpha=0.18, linewidth=0)
                shown += [below.min(), above.max()]
        axes.set_ylim(max(low, min(shown) / 1.05), min(high, max(shown) * 1.05))
        for scale in scales:
            _plain_ticks(getattr(axes, f"{scale}axis"))
        axes.legend(frameon=False)
        return _svg(axes.figure, label)


def scatter(
    clouds: Sequence[Cloud],
    x: str,
    y: str,
    label: str,
    *,
    front: Sequence[tuple[float, float]] = (),
    png: Path | None = None,
) -> str:
    """Labeled points with error bars on logarithmic axes, and a Pareto front as a stepped line.

    Parameters
    ----------
    png : file for the same plot on white
    """
    with _style(label):
        figure = _scatter(clouds, x, y, front)
        if png is not None:
            options = {"dpi": 160, "facecolor": "white", "metadata": {"Software": None}}
            figure.patch.set_alpha(1.0)
            write_through(png, lambda path: figure.savefig(path, format="png", **options))
            figure.patch.set_alpha(0.0)
        return _svg(figure, label)


def _scatter(clouds: Sequence[Cloud], x: str, y: str, front: Sequence[tuple[float, float]]) -> Any:
    axes = _axes(x, y, "xy", 7.2, 4.2)
    floor = _limits([v for cloud in clouds for v in cloud.y])[0]
    handles = []
    for index, cloud in enumerate(clouds):
        xs, ys = np.asarray(cloud.x, float), np.maximum(np.asarray(cloud.y, float), floor)
        x_error = np.minimum(np.asarray(cloud.x_error, float), 0.95 * xs)
        y_error = np.minimum(np.asarray(cloud.y_error, float), 0.95 * ys)
        drawn = _error_bars(axes, index, xs, ys, x_error, y_error, cloud.hollow)
        handles.append((drawn.lines[0], cloud.name))
        if cloud.joined:
            axes.plot(xs, ys, color=color(index), linewidth=0.8, alpha=0.5)
        for x0, y0, text in zip(xs, ys, cloud.labels, strict=True):
            # The front descends to the right, so that it leaves this corner free.
            note = axes.annotate(
                text, (x0, y0), (6, 5), textcoords="offset points", fontsize=_LABEL_SIZE, color=color(index)
            )
            # Otherwise constrained layout would shrink the axes for the label.
            note.set_in_layout(False)
    if front:
        drawn = axes.step(*np.asarray(front, float).T, where="post", color=_INK, lw=1.3, ls=(0, (4, 2)))
        handles.append((drawn[0], "Pareto front"))
    axes.margins(y=0.1)
    # Space for labels on the right.
    left, right = axes.get_xlim()
    if right < 1.01 * left:  # A single time: the limits differ by rounding alone.
        left, right = left / 1.5, right * 1.5
    axes.set_xlim(left / (right / left) ** 0.06, right * (right / left) ** 0.2)
    for axis in (axes.xaxis, axes.yaxis):
        _plain_ticks(axis)
    marks, names = zip(*handles, strict=True)
    axes.figure.legend(marks, names, ncols=2, loc="outside upper left", frameon=False, fontsize=8.5)
    return axes.figure


def _error_bars(
    axes: Any, index: int, x: Any, y: Any, x_error: Any, y_error: Any, hollow: bool = False, **more: Any
) -> Any:
    """Points of one series with error bars."""
    return axes.errorbar(
        x,
        y,
        y_error,
        x_error,
        fmt=MARKERS[index % len(MARKERS)],
        color=color(index),
        markerfacecolor="none" if hollow else color(index),
        markersize=5.5,
        capsize=2.5,
        linewidth=1.1,
        **more,
    )


def points(
    groups: Sequence[str],
    series: Mapping[str, Sequence[tuple[float, float] | None]],
    x: str,
    y: str,
    label: str,
) -> str:
    """Values with error bars by group, one series per fit; None leaves a point out."""
    with _style(label):
        axes = _axes(x, y, "y")
        for index, (name, values) in enumerate(series.items()):
            shift = 0.16 * (index - (len(series) - 1) / 2)
            shown = [(g + shift, *v) for g, v in enumerate(values) if v is not None and v[0] > 0]
            if not shown:
                continue
            xs, ys, es = np.asarray(shown, float).T
            _error_bars(axes, index, xs, ys, None, np.minimum(es, 0.95 * ys), label=name)
            axes.plot(xs, ys, color=color(index), linewidth=0.8, alpha=0.45)
        axes.set_xticks(range(len(groups)), groups)
        axes.set_xlim(-0.6, len(groups) - 0.4)
        # The values set the range: an error bar that reaches zero has no end on a logarithmic axis.
        axes.set_ylim(*_limits([v[0] for row in series.values() for v in row if v is not None]))
        _plain_ticks(axes.yaxis)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False)
        return _svg(axes.figure, label)


def _plain_ticks(axis: Any) -> None:
    """Ticks of a logarithmic axis at 1, 2 and 5 of each decade, denser for short ranges, sparser for long."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    decades = float(np.log10(high / low)) if 0 < low < high else 9.0
    densities = {
        0.35: np.arange(1.0, 10.0, 0.5),
        0.6: (1, 1.5, 2, 3, 4, 5, 7),
        2.2: (1, 2, 5),
        math.inf: (1,),
    }
    subs = next(subs for most, subs in densities.items() if decades < most)
    axis.set_major_locator(LogLocator(base=10, subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axis.set_minor_formatter(NullFormatter())


def bars(parts: Sequence[tuple[str, float]], x: str, label: str) -> str:
    """Horizontal bars, the first on top, each labeled with its value."""
    with _style(label):
        axes = _axes(x, "", "", height=0.42 * len(parts) + 0.75)
        names, values = zip(*parts, strict=True)
        drawn = axes.barh(names, values, color=COLORS[0], height=0.62)
        axes.bar_label(drawn, fmt="{:.3g}", padding=5)
        axes.invert_yaxis()
        axes.grid(False, axis="y")
        axes.set_axisbelow(True)
        axes.set_xlim(0, 1.18 * max([*values, 1e-9]))
        return _svg(axes.figure, label)

"""Plots of queries: positions on the tile, levels, directions of light and view."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.files.atomic import write_file
from mbtf_gen.pictures.preview.sample import QuerySample

# Number of points below which points are plotted instead of a histogram.
_SCATTER = 4000
# Approximate queries per bin of a 2D histogram, and smallest and largest number of bins per side.
_PER_BIN, _FEWEST, _MOST = 60, 8, 96
# Bins per level where there are at least _PER_BIN queries for each, else whole levels.
_BINS_PER_LEVEL = 8
_INK, _STATED = "#3b6ea5", "#c2571a"


def level_histogram(
    sample: QuerySample,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """(bin edges, density of the queries, stated density) of the fractional level.

    Bins are an eighth of a level wide, or a whole level where queries are few. With k = 0 there is one bin
    around 0, whose stated density is 1.
    """
    if sample.finest == 0:
        edges, stated = np.array([-0.5, 0.5]), np.ones(1)
    else:
        enough = len(sample.level) >= _PER_BIN * _BINS_PER_LEVEL * sample.finest
        bins = sample.finest * (_BINS_PER_LEVEL if enough else 1)
        edges = np.linspace(0.0, sample.finest, bins + 1)
        stated = sample.mixture.density(0.5 * (edges[1:] + edges[:-1]), sample.finest)
    # Footprints are stored in single precision, so that levels may exceed k by rounding.
    inside = np.clip(sample.level, edges[0], edges[-1])
    found, _ = np.histogram(inside, edges, density=True)
    return edges, found, stated


def query_figure(sample: QuerySample, title: str) -> Any:
    """Matplotlib figure of four plots: positions, levels, ω_i, ω_o."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 10.0), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.15)
    figure.suptitle(title, wrap=True)
    position, level, light, view = figure.subplots(2, 2).ravel()
    _positions(position, sample)
    _levels(level, sample)
    _directions(light, sample.omega_i, sample.min_cos, "ω_i, towards the light")
    _directions(view, sample.omega_o, sample.min_cos, "ω_o, towards the viewer")
    return figure


def write_plots(path: Path, sample: QuerySample, title: str) -> None:
    """Write :func:`query_figure` as a PNG, atomically."""
    figure = query_figure(sample, title)
    write_file(path, lambda stream: figure.savefig(stream, format="png", dpi=100))


def _bins(count: int) -> int:
    return int(np.clip(np.sqrt(count / _PER_BIN), _FEWEST, _MOST))


def _spread(axes: Any, x: Any, y: Any, bins: tuple[int, int], extent: Any) -> None:
    """Points, or a histogram of many."""
    if len(x) < _SCATTER:
        axes.scatter(x, y, s=4 if len(x) > 500 else 16, color=_INK, linewidths=0)
        return
    *_, shown = axes.hist2d(x, y, bins, extent, density=True, cmap="Blues", cmin=1e-12)
    shown.set_clim(vmin=0.0)
    axes.figure.colorbar(shown, ax=axes, label="density", shrink=0.85)


def _positions(axes: Any, sample: QuerySample) -> None:
    u, v = sample.u.T
    axes.set(title="positions", xlabel="u", ylabel="v", xlim=(0, 1), ylim=(0, 1), aspect=sample.aspect)
    columns = _bins(round(len(u) * max(1.0, 1.0 / sample.aspect)))
    _spread(axes, u, v, (columns, max(1, round(sample.aspect * columns))), ((0, 1), (0, 1)))


def _levels(axes: Any, sample: QuerySample) -> None:
    edges, found, stated = level_histogram(sample)
    axes.stairs(found, edges, fill=True, color=_INK, alpha=0.6, label="queries")
    axes.stairs(stated, edges, color=_STATED, linewidth=2.0, label="stated mixture")
    finest = f"k = {sample.finest} the finest texel"
    axes.set(title="levels", xlabel=f"level l = -log2(2σ): 0 is the tile, {finest}", ylabel="density")
    axes.set_ylim(0.0, 1.35 * float(max(found.max(), stated.max())))
    axes.legend(loc="upper left", frameon=False)


def _directions(axes: Any, omega: NDArray[np.float32], min_cos: float, title: str) -> None:
    x, y = omega[:, 0], omega[:, 1]
    radius = float(np.sqrt(1.0 - min_cos**2))
    axes.set(title=title, xlabel="x", ylabel="y", xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), aspect="equal")
    _spread(axes, x, y, (_bins(len(x)),) * 2, ((-1, 1), (-1, 1)))
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    ring = np.stack([np.cos(angle), np.sin(angle)])
    axes.plot(*ring, color="0.6", linewidth=1.0, label="horizon")
    axes.plot(*(radius * ring), color=_STATED, linewidth=1.5, label=f"cos = {min_cos:g}")
    axes.legend(loc="upper right", frameon=False, fontsize="small")

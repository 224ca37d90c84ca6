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


def _points(axes: Any, x: Any, y: Any) -> None:
    axes.scatter(x, y, s=4 if len(x) > 500 else 16, color=_INK, linewidths=0)


def _relative(axes: Any, x: Any, y: Any, edges: Any, share: NDArray[np.float64], region: str) -> None:
    """Histogram relative to a uniform distribution, which has the fraction `share` of its queries per bin."""
    counts, _, _ = np.histogram2d(x, y, edges)
    # Bins that hardly overlap the region are left out; bins outside of it must be empty.
    full = share > 0.25 * share.max()
    ratio = np.where(full, counts / (len(x) * np.where(full, share, 1.0)), np.nan)
    ratio[(share == 0) & (counts > 0)] = 2.0
    shown = axes.pcolormesh(*edges, np.minimum(ratio, 2.0).T, vmin=0.0, vmax=2.0, cmap="RdBu_r")
    axes.figure.colorbar(shown, ax=axes, label=f"density relative to uniform over {region}", shrink=0.85)


def _disk_share(edges: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Fraction of a disk around 0 in each bin of a square grid, from 16 × 16 points per bin."""
    step = (np.arange(16) + 0.5) / 16
    x = (edges[:-1, None] + step * np.diff(edges)[:, None]).ravel()
    inside = (x[:, None] ** 2 + x[None, :] ** 2 <= radius**2).astype(np.float64)
    bins = len(edges) - 1
    share: NDArray[np.float64] = inside.reshape(bins, 16, bins, 16).sum(axis=(1, 3))
    return share / share.sum()


def _positions(axes: Any, sample: QuerySample) -> None:
    u, v = sample.u.T
    axes.set(title="positions", xlabel="u", ylabel="v", xlim=(0, 1), ylim=(0, 1), aspect=sample.aspect)
    if len(u) < _SCATTER:
        _points(axes, u, v)
        return
    columns = _bins(round(len(u) * max(1.0, 1.0 / sample.aspect)))
    rows = max(1, round(sample.aspect * columns))
    share = np.full((columns, rows), 1.0 / (columns * rows))
    _relative(axes, u, v, (np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1)), share, "the tile")


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
    if len(x) < _SCATTER:
        _points(axes, x, y)
    else:
        edges = np.linspace(-1.0, 1.0, _bins(len(x)) + 1)
        _relative(axes, x, y, (edges, edges), _disk_share(edges, radius), "the disk")
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    ring = np.stack([np.cos(angle), np.sin(angle)])
    axes.plot(*ring, color="0.6", linewidth=1.0, label="horizon")
    axes.plot(*(radius * ring), color=_STATED, linewidth=1.5, label=f"cos = {min_cos:g}")
    axes.legend(loc="upper right", frameon=False, fontsize="small")

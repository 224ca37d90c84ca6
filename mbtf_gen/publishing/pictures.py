"""Pictures of a data card, drawn from the stored values alone."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import linear_to_srgb
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.geometry import Geometry
from mbtf_core.exposure import auto_exposure, brightness, to_display
from mbtf_core.files.atomic import Stored, write_chunks
from mbtf_gen.pictures.preview.plots import query_figure
from mbtf_gen.pictures.preview.sample import stored_queries
from mbtf_gen.publishing.averages import ELEVATIONS, LIGHTS, Averages, averages
from mbtf_gen.publishing.statistics import HIGHEST_DECADE, LOWEST_DECADE, PER_DECADE, SplitStatistics

# What is shown where there is no query.
_EMPTY = 238
_CHANNELS = {"R": "#c0392b", "G": "#27803b", "B": "#2c5faa"}
_TRAIN, _TEST = "#3b6ea5", "#c2571a"

Makers = dict[str, Callable[[Path], Stored]]


def picture_makers(data: Dataset, found: Callable[[], Mapping[str, SplitStatistics]]) -> Makers:
    """Writers of the pictures of a data set, by file name.

    Parameters
    ----------
    data : Dataset
        A complete data set.
    found : callable
        Returns the statistics of its splits.
    """
    cache: list[Averages] = []

    def mean() -> Averages:
        if not cache:
            cache.append(averages(data))
        return cache[0]

    makers: Makers = {
        "tile.png": lambda path: _save(path, tile_figure(data, mean())),
        "brdf.png": lambda path: _save(path, brdf_figure(mean())),
        "values.png": lambda path: _save(path, value_figure(found())),
    }
    if "mixture" in data.manifest["levels"]:
        makers["queries.png"] = lambda path: _save(path, _query_figure(data))
    if data.manifest["geometry"] is not None:
        makers["surface.png"] = lambda path: _save(path, surface_figure(_geometry(data)))
    return makers


def _geometry(data: Dataset) -> Geometry:
    geometry = data.geometry()
    assert geometry is not None
    return geometry


def _save(path: Path, figure: Any) -> Stored:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=100)
    return write_chunks(path, [stream.getvalue()])


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def displayed(pictures: NDArray[np.float64]) -> NDArray[np.uint8]:
    """8-bit sRGB of pictures (..., 3) at one exposure; pixels without queries are light gray."""
    known = np.asarray(np.isfinite(pictures).all(axis=-1))
    exposure = auto_exposure([brightness(pictures[known])] if known.any() else [0.0])
    shown = to_display(np.where(known[..., None], pictures, 0.0), exposure)
    shown[~known] = _EMPTY
    return shown


def tile_figure(data: Dataset, found: Averages) -> Any:
    """Matplotlib figure of the tile under all lights, and under lights from three sides."""
    aspect = data.lattice.aspect
    figure = _figure(3.0 * len(LIGHTS), 3.0 * float(np.clip(aspect, 0.3, 3.0)) + 0.5)
    pictures = displayed(found.tile)
    for axes, name, picture in zip(
        figure.subplots(1, len(LIGHTS), squeeze=False)[0], LIGHTS, pictures, strict=True
    ):
        axes.imshow(picture, extent=(0, 1, 0, aspect), interpolation="nearest")
        axes.set(title=name, xticks=(), yticks=())
    return figure


def brdf_figure(found: Averages) -> Any:
    """Matplotlib figure of the apparent BRDF by direction of view, for three elevations of the light."""
    from matplotlib.patches import Circle

    figure = _figure(3.4 * len(ELEVATIONS), 3.9)
    pictures = displayed(found.brdf)
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    for axes, (low, high), picture in zip(
        figure.subplots(1, len(ELEVATIONS)), ELEVATIONS, pictures, strict=True
    ):
        shown = axes.imshow(picture, extent=(-1, 1, -1, 1), interpolation="nearest")
        shown.set_clip_path(Circle((0.0, 0.0), 1.0, transform=axes.transData))
        axes.plot(np.cos(angle), np.sin(angle), color="0.6", linewidth=1.0)
        middle = np.radians(0.5 * (low + high))
        axes.plot(
            np.cos(middle), 0.0, marker="*", markersize=12, color="#f5c518", markeredgecolor="0.2", ls="none"
        )
        axes.set(title=f"light {low:g}° to {high:g}° above the plane", xlim=(-1.05, 1.05), ylim=(-1.05, 1.05))
        axes.set(xlabel="x of ω_o", ylabel="y of ω_o", aspect="equal")
    return figure


def value_figure(found: Mapping[str, SplitStatistics]) -> Any:
    """Matplotlib figure of the values' histogram, the queries per level, and the noise per level."""
    noisy = any(split.estimates == 2 for split in found.values())
    figure = _figure(12.0 if noisy else 8.4, 3.8)
    values, levels, *rest = figure.subplots(1, 3 if noisy else 2)
    _histogram(values, found)
    for (name, split), color, shift in zip(found.items(), (_TRAIN, _TEST), (-0.2, 0.2), strict=False):
        total = max(split.queries, 1)
        keys = sorted(split.level_queries)
        levels.bar(
            [k + shift for k in keys],
            [split.level_queries[k] / total for k in keys],
            0.4,
            color=color,
            label=f"{name}, {split.queries:,}",
        )
        for axes in rest:
            noise = {k: n for k in keys if (n := split.noise(k)) is not None and np.isfinite(n.error)}
            axes.errorbar(
                list(noise),
                [100 * n.value for n in noise.values()],
                [100 * n.error for n in noise.values()],
                color=color,
                marker="o",
                markersize=4,
                capsize=3,
                label=name,
            )
    levels.set(
        title="queries per level", xlabel="level of detail (0: the tile)", ylabel="fraction of the split"
    )
    for axes in rest:
        axes.set(title="noise per level", xlabel="level of detail", ylabel="noise of a value, % of the mean")
        axes.set_ylim(bottom=0)
    for axes in (levels, *rest):
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.legend(frameon=False)
    return figure


def _histogram(axes: Any, found: Mapping[str, SplitStatistics]) -> None:
    counts = sum(split.histogram for split in found.values())
    edges = 10.0 ** (
        LOWEST_DECADE + np.arange((HIGHEST_DECADE - LOWEST_DECADE) * PER_DECADE + 1) / PER_DECADE
    )
    # Single values far from all others would only widen the axis.
    used = np.flatnonzero(np.asarray(counts).sum(axis=1) > 1e-4 * np.max(counts))
    total = max(1, sum(split.queries for split in found.values()))
    if len(used):
        part = slice(used[0], used[-1] + 1)
        for channel, (name, color) in enumerate(_CHANNELS.items()):
            density = np.asarray(counts)[part, channel] * PER_DECADE / total
            axes.stairs(density, edges[used[0] : used[-1] + 2], color=color, label=name)
    axes.set(title="values", xlabel="value in 1/sr", ylabel="density per decade", xscale="log")
    axes.legend(frameon=False, loc="upper left")


def _query_figure(data: Dataset) -> Any:
    sample = stored_queries(data)
    return query_figure(sample, f"{len(sample.u):,} of {sample.total:,} training queries")


def surface_figure(geometry: Geometry) -> Any:
    """Matplotlib figure of the heights as traced, and of the base color where it is known."""
    colored = geometry.base_color is not None
    figure = _figure(8.8 if colored else 5.0, 4.0)
    axes = figure.subplots(1, 2 if colored else 1, squeeze=False)[0]
    extent = (0, 1, 0, geometry.aspect)
    shown = axes[0].imshow(geometry.heights, extent=extent, cmap="gray", interpolation="nearest")
    axes[0].set(title="heights as traced", xlabel="u", ylabel="x₂ in tile widths")
    figure.colorbar(shown, ax=axes[0], label="tile widths", shrink=0.85)
    if geometry.base_color is not None:
        color = np.clip(linear_to_srgb(np.clip(geometry.base_color.astype(np.float64), 0.0, 1.0)), 0.0, 1.0)
        axes[1].imshow(color, extent=extent, interpolation="nearest")
        axes[1].set(title="base color", xlabel="u", ylabel="x₂ in tile widths")
    return figure

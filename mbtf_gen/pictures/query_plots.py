"""Plots of the queries that a configuration samples: positions on the tile, levels, directions of light and
view."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.lattice import level_of_sigma
from mbtf_core.data.schema import Queries
from mbtf_core.files.atomic import write_file
from mbtf_gen.job import Job, split_queries

# Shards are sampled until there are this many queries.
MAX_QUERIES = 1 << 20
# Approximate queries per bin of a 2D histogram, and smallest and largest number of bins per side; bins per
# level.
_PER_BIN, _FEWEST, _MOST, _PER_LEVEL = 60, 8, 96, 8
_INK, _LIMIT = "#3b6ea5", "#c2571a"


def first_queries(job: Job) -> Queries:
    """Training queries of the first shards of a job, with one axis."""
    parts: list[Queries] = []
    for entry in (entry for entry in job.shards if entry.split == "train"):
        parts.append(job.query_plan.draw("train", entry.index, entry.rows).flat())
        if sum(part.sigma.size for part in parts) >= MAX_QUERIES:
            break
    return Queries(
        *(np.concatenate(arrays) for arrays in zip(*(vars(p).values() for p in parts), strict=True))
    )


def write_plots(path: Path, job: Job) -> str:
    """Write four plots of a job's queries as a PNG, atomically: positions, levels, ω_i, ω_o; returns what
    they show."""
    from matplotlib.figure import Figure

    queries, min_cos, finest = first_queries(job), job.config.queries.min_cos, job.lattice.finest
    total = split_queries(job, "train")
    shown = f"{queries.sigma.size} of {total} training queries sampled for {job.config.material}"
    figure = Figure(figsize=(11.0, 10.0), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.15)
    figure.suptitle(shown, wrap=True)
    position, level, light, view = figure.subplots(2, 2).ravel()
    _positions(position, queries.u, job.lattice.aspect)
    level.hist(level_of_sigma(queries.sigma), max(1, _PER_LEVEL * finest), color=_INK, density=True)
    axis = f"level l = -log2(2σ): 0 is the tile, k = {finest} the finest texel"
    level.set(title="levels", xlabel=axis, ylabel="density")
    _directions(light, queries.omega_i, min_cos, "ω_i, towards the light")
    _directions(view, queries.omega_o, min_cos, "ω_o, towards the viewer")
    write_file(path, lambda stream: figure.savefig(stream, format="png", dpi=100))
    return f"positions, levels and directions of {shown}"


def _bins(count: int) -> int:
    return int(np.clip(np.sqrt(count / _PER_BIN), _FEWEST, _MOST))


def _spread(axes: Any, x: Any, y: Any, bins: tuple[int, int], extent: Any) -> None:
    """A histogram of points."""
    *_, shown = axes.hist2d(x, y, bins, extent, density=True, cmap="Blues", cmin=1e-12)
    shown.set_clim(vmin=0.0)
    axes.figure.colorbar(shown, ax=axes, label="density", shrink=0.85)


def _positions(axes: Any, positions: NDArray[np.float32], aspect: float) -> None:
    axes.set(title="positions", xlabel="u", ylabel="v", xlim=(0, 1), ylim=(0, 1), aspect=aspect)
    columns = _bins(round(len(positions) * max(1.0, 1.0 / aspect)))
    u, v = positions.T
    _spread(axes, u, v, (columns, max(1, round(aspect * columns))), ((0, 1), (0, 1)))


def _directions(axes: Any, omega: NDArray[np.float32], min_cos: float, title: str) -> None:
    x, y = omega[:, 0], omega[:, 1]
    radius = float(np.sqrt(1.0 - min_cos**2))
    axes.set(title=title, xlabel="x", ylabel="y", xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), aspect="equal")
    _spread(axes, x, y, (_bins(len(x)),) * 2, ((-1, 1), (-1, 1)))
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    # The horizon is the unit circle, so near that it would only hide this one.
    ring = radius * np.stack([np.cos(angle), np.sin(angle)])
    axes.plot(*ring, color=_LIMIT, linewidth=1.5, label=f"smallest cosine: {min_cos:g}")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), frameon=False, fontsize="small")

"""Plots of queries: positions on the tile, levels, directions of light and view.

The queries are those that a configuration samples, or those stored in shards.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import level_of_sigma
from mbtf_core.data.schema import Queries
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import write_file
from mbtf_gen.job import Job, split_queries
from mbtf_gen.sampling.query_sampler import LevelMixture

# Shards are read until there are this many queries.
MAX_QUERIES = 1 << 20
# Approximate queries per bin of a 2D histogram, and smallest and largest number of bins per side.
_PER_BIN, _FEWEST, _MOST = 60, 8, 96
# Bins per level where there are at least _PER_BIN queries for each, else whole levels.
_BINS_PER_LEVEL = 8
_INK, _STATED = "#3b6ea5", "#c2571a"


@dataclass(frozen=True)
class QuerySample:
    """Training queries, and the distributions that they should follow.

    Attributes
    ----------
    queries : one axis
    total : training queries of the whole data set
    mixture, finest : of the levels; min_cos : of both directions; aspect : H/W of the tile
    """

    queries: Queries
    total: int
    mixture: LevelMixture
    finest: int
    min_cos: float
    aspect: float

    @property
    def level(self) -> NDArray[np.float64]:
        """Fractional levels (n,)."""
        return level_of_sigma(self.queries.sigma)


def sampled_queries(job: Job) -> QuerySample:
    """Queries of the first shards that a configuration samples."""
    plan, entries = job.query_plan, (entry for entry in job.shards if entry.split == "train")
    first = _first(plan.draw("train", entry.index, entry.rows) for entry in entries)
    total = split_queries(job, "train")
    return QuerySample(first, total, plan.mixture, job.lattice.finest, plan.min_cos, job.lattice.aspect)


def stored_queries(dataset: Dataset) -> QuerySample:
    """Queries of the first finished shards of a data set, with the distributions stated in its manifest.

    Raises
    ------
    InputError : no shard is finished, or one cannot be read
    """
    manifest, shards = dataset.manifest, dataset.shards("train", finished_only=True)
    if not shards:
        raise InputError(
            "contains no finished train shard yet",
            where=dataset.folder,
            hint="run the mbtf-gen command that made the folder again: it resumes",
        )
    return QuerySample(
        _first(Queries(**shard.read(("u", "sigma", "omega_i", "omega_o"))) for shard in shards),
        int(manifest["splits"]["train"]["queries"]),
        LevelMixture(**manifest["levels"]["mixture"]),
        dataset.lattice.finest,
        float(manifest["config"]["queries"]["min_cos"]),
        dataset.lattice.aspect,
    )


def _first(batches: Iterable[Queries]) -> Queries:
    """The first batches that reach the limit, as one."""
    parts: list[Queries] = []
    for batch in batches:
        parts.append(batch.flat())
        if sum(part.sigma.size for part in parts) >= MAX_QUERIES:
            break
    return Queries(
        *(np.concatenate(arrays) for arrays in zip(*(vars(p).values() for p in parts), strict=True))
    )


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
        enough = sample.queries.sigma.size >= _PER_BIN * _BINS_PER_LEVEL * sample.finest
        bins = sample.finest * (_BINS_PER_LEVEL if enough else 1)
        edges = np.linspace(0.0, sample.finest, bins + 1)
        stated = sample.mixture.density(0.5 * (edges[1:] + edges[:-1]), sample.finest)
    # Footprints are stored in single precision, so that levels may exceed k by rounding.
    inside = np.clip(sample.level, edges[0], edges[-1])
    found, _ = np.histogram(inside, edges, density=True)
    return edges, found, stated


def write_plots(path: Path, sample: QuerySample, title: str) -> None:
    """Write four plots as a PNG, atomically: positions, levels, ω_i, ω_o."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 10.0), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.15)
    figure.suptitle(title, wrap=True)
    position, level, light, view = figure.subplots(2, 2).ravel()
    _positions(position, sample)
    _levels(level, sample)
    _directions(light, sample.queries.omega_i, sample.min_cos, "ω_i, towards the light")
    _directions(view, sample.queries.omega_o, sample.min_cos, "ω_o, towards the viewer")
    write_file(path, lambda stream: figure.savefig(stream, format="png", dpi=100))


def _bins(count: int) -> int:
    return int(np.clip(np.sqrt(count / _PER_BIN), _FEWEST, _MOST))


def _spread(axes: Any, x: Any, y: Any, bins: tuple[int, int], extent: Any) -> None:
    """A histogram of points."""
    *_, shown = axes.hist2d(x, y, bins, extent, density=True, cmap="Blues", cmin=1e-12)
    shown.set_clim(vmin=0.0)
    axes.figure.colorbar(shown, ax=axes, label="density", shrink=0.85)


def _positions(axes: Any, sample: QuerySample) -> None:
    u, v = sample.queries.u.T
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
    # The horizon is the unit circle, so near that it would only hide this one.
    ring = radius * np.stack([np.cos(angle), np.sin(angle)])
    axes.plot(*ring, color=_STATED, linewidth=1.5, label=f"smallest cosine: {min_cos:g}")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), frameon=False, fontsize="small")

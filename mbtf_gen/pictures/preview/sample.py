"""The queries that a preview plots: those that a configuration samples, or those stored in shards."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import level_of_sigma
from mbtf_core.data.schema import Queries
from mbtf_core.errors import InputError
from mbtf_gen.job import Job, split_queries
from mbtf_gen.sampling.query_sampler import LevelMixture

# Shards are read until there are this many queries.
MAX_QUERIES = 1 << 20


@dataclass(frozen=True)
class QuerySample:
    """Training queries, and the distributions that they should follow.

    Attributes
    ----------
    u : (n, 2) uv
    level : (m,) fractional levels; omega_i, omega_o : (m, 3). One per query, or one per image in the image
        layout, whose queries share them.
    total : training queries of the whole data set
    mixture, finest : of the levels; min_cos : of both directions; aspect : H/W of the tile
    """

    u: NDArray[np.float32]
    level: NDArray[np.float64]
    omega_i: NDArray[np.float32]
    omega_o: NDArray[np.float32]
    total: int
    mixture: LevelMixture
    finest: int
    min_cos: float
    aspect: float


def sampled_queries(job: Job) -> QuerySample:
    """Queries of the first shards that a configuration samples."""
    plan, entries = job.query_plan, (entry for entry in job.shards if entry.split == "train")
    columns = _columns(plan.draw("train", entry.index, entry.rows) for entry in entries)
    total = split_queries(job, "train")
    return QuerySample(*columns, total, plan.mixture, job.lattice.finest, plan.min_cos, job.lattice.aspect)


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
    names = ("u", "sigma", "omega_i", "omega_o")
    return QuerySample(
        *_columns(Queries(**shard.read(names)) for shard in shards),
        int(manifest["splits"]["train"]["queries"]),
        LevelMixture(**manifest["levels"]["mixture"]),
        dataset.lattice.finest,
        float(manifest["config"]["queries"]["min_cos"]),
        dataset.lattice.aspect,
    )


def _columns(batches: Iterable[Queries]) -> tuple[Any, Any, Any, Any]:
    """Positions, levels and directions of the first batches that reach the limit."""
    parts: list[Queries] = []
    for batch in batches:
        parts.append(batch)
        if sum(part.sigma.size for part in parts) >= MAX_QUERIES:
            break
    # The image layout repeats footprint and directions over an image: its first query stands for it.
    one: Any = (slice(None), *(0,) * (len(parts[0].lead) - 1))
    return (
        np.concatenate([p.u.reshape(-1, 2) for p in parts]),
        level_of_sigma(np.concatenate([p.sigma[one] for p in parts])),
        np.concatenate([p.omega_i[one] for p in parts]),
        np.concatenate([p.omega_o[one] for p in parts]),
    )

"""The queries that a preview plots: those that a configuration samples, or those stored in shards."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.lattice import level_of_sigma
from mbtf_core.shard_schema import Split
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.shard_io import read_shard
from mbtf_gen.dataset.verify import finished_record
from mbtf_gen.job import Job, split_queries
from mbtf_gen.sampling.query_sampler import Mixture, Queries

# Shards are read until there are this many queries.
MAX_QUERIES = 1 << 20


@dataclass(frozen=True)
class QuerySample:
    """Queries of one split, and the distributions that they should follow.

    Attributes
    ----------
    u : (n, 2) uv
    level : (m,) fractional levels; omega_i, omega_o : (m, 3). One per query, or one per image in the image
        layout, whose queries share them.
    split : of the data set; shards : taken; total : queries of the whole split
    mixture, finest : of the levels; min_cos : of both directions; aspect : H/W of the tile
    """

    u: NDArray[np.float32]
    level: NDArray[np.float64]
    omega_i: NDArray[np.float32]
    omega_o: NDArray[np.float32]
    split: Split
    shards: int
    total: int
    mixture: Mixture
    finest: int
    min_cos: float
    aspect: float


def sampled_queries(job: Job, split: Split = "train") -> QuerySample:
    """Queries of the first shards that a configuration samples."""
    plan, entries = job.query_plan, [entry for entry in job.shards if entry.split == split]
    parts = list(_up_to_limit(plan.draw(split, entry.index, entry.rows) for entry in entries))
    return QuerySample(
        *_columns(parts),
        split,
        len(parts),
        split_queries(job, split),
        plan.mixture,
        job.lattice.finest,
        plan.min_cos,
        job.lattice.aspect,
    )


def finished_shards(dataset: Dataset, split: Split) -> list[Path]:
    """Files of a split's finished shards, in order."""
    manifest = dataset.manifest
    return [
        dataset.folder / entry["file"]
        for entry in manifest["splits"][split]["shards"]
        if finished_record(dataset.folder / entry["file"], entry["rows"], manifest["config_hash"])
    ]


def stored_queries(dataset: Dataset, split: Split = "train") -> QuerySample:
    """Queries of the first finished shards of a data set, with the distributions stated in its manifest.

    Raises
    ------
    InputError : no shard of the split is finished, or one cannot be read
    """
    manifest = dataset.manifest
    names = ("u", "sigma", "omega_i", "omega_o")
    parts = list(_up_to_limit(Queries(**read_shard(path, names)) for path in finished_shards(dataset, split)))
    if not parts:
        raise InputError(
            f"holds no finished {split} shard yet",
            where=dataset.folder,
            hint="run the mbtf-gen command that made the folder again: it resumes",
        )
    return QuerySample(
        *_columns(parts),
        split,
        len(parts),
        int(manifest["splits"][split]["queries"]),
        Mixture(**manifest["levels"]["mixture"]),
        dataset.lattice.finest,
        float(manifest["config"]["queries"]["min_cos"]),
        dataset.lattice.aspect,
    )


def _up_to_limit(batches: Iterable[Queries]) -> Iterator[Queries]:
    count = 0
    for batch in batches:
        yield batch
        count += batch.sigma.size
        if count >= MAX_QUERIES:
            return


def _columns(
    parts: list[Queries],
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    first = parts[0]
    # The image layout repeats footprint and directions over an image: its first query stands for it.
    one: Any = (slice(None), *(0,) * (len(first.lead) - 1))
    return (
        np.concatenate([p.u.reshape(-1, 2) for p in parts]),
        level_of_sigma(np.concatenate([p.sigma[one] for p in parts])),
        np.concatenate([p.omega_i[one] for p in parts]),
        np.concatenate([p.omega_o[one] for p in parts]),
    )

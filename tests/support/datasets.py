"""Finished data sets without rendering: real queries, manifest and sidecars, values from a formula."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.atomic import checksummed
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.dataset.folder import open_folder
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.render_shards import store_shard
from mbtf_gen.dataset.summary import finish
from mbtf_gen.job import Job, split_spp
from mbtf_gen.planning.effects_plan import reference_plan
from mbtf_gen.planning.run_plan import RunPlan
from mbtf_gen.render.estimates import Estimates
from mbtf_gen.sampling.query_sampler import Queries

F32 = NDArray[np.float32]
NOISE = 0.05


def formula(queries: Queries) -> NDArray[np.float64]:
    """Noise-free values (..., 3): smooth in every query variable."""
    u, s = queries.u.astype(np.float64), queries.sigma.astype(np.float64)
    base = 0.3 + 0.1 * np.sin(2 * np.pi * (u[..., 0] - 2 * u[..., 1])) * np.exp(-4 * s)
    shade = 0.5 + 0.5 * queries.omega_i[..., 2] * queries.omega_o[..., 2]
    return (base * shade)[..., None] * np.array([1.0, 0.8, 0.5])


def write_dataset(folder: Path, *, rows: int = 4, columns: int = 8, **options: Any) -> Dataset:
    """Write a data set of a random height map of `rows` × `columns` texels.

    Parameters
    ----------
    options : sections of the configuration, as :class:`~mbtf_gen.config.generator.GeneratorConfig` takes them
    """
    heights = folder.parent / f"{folder.name}.npy"
    folder.parent.mkdir(parents=True, exist_ok=True)
    np.save(heights, 0.1 * np.random.default_rng(0).random((rows, columns)))
    config = GeneratorConfig.model_validate({"material": str(heights), **options})
    job = Job.prepare(config)
    plan = RunPlan(reference_plan(job))
    open_folder(job, folder, lambda job: plan, False)
    for number, entry in enumerate(job.shards):
        queries = job.query_plan.draw(entry.split, entry.index, entry.rows)
        truth, rng = formula(queries), np.random.default_rng(number)
        a, b = ((truth * (1 + NOISE * rng.normal(size=truth.shape))).astype(np.float32) for _ in range(2))
        paths = queries.sigma.size * split_spp(config, entry.split)
        made = Estimates(a.reshape(-1, 3), b.reshape(-1, 3), None, paths, 0, 0, 0)
        store_shard(job, folder, plan, entry, queries, made, 0.1)
    finish(folder)
    return Dataset.open(folder)


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a manifest or a sidecar by hand, its checksum with it."""
    document = json.loads(path.read_text())
    change(document)
    path.write_bytes(checksummed(document))

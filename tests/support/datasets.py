"""Finished data sets without rendering: real queries, manifest and sidecars, values from a formula."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.atomic import write_json
from mbtf_gen.config import GeneratorConfig
from mbtf_gen.dataset import Dataset
from mbtf_gen.generation import Job, _sidecar
from mbtf_gen.manifest import build_manifest
from mbtf_gen.output_folder import open_folder
from mbtf_gen.planning import simulated
from mbtf_gen.queries import Queries
from mbtf_gen.schema import SPLITS
from mbtf_gen.shard_files import write_shard
from mbtf_gen.summary import finish
from mbtf_gen.verification import sidecar_of

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
    options : sections of the configuration, as :class:`~mbtf_gen.config.GeneratorConfig` takes them
    """
    heights = folder.parent / f"{folder.name}.npy"
    folder.parent.mkdir(parents=True, exist_ok=True)
    np.save(heights, 0.1 * np.random.default_rng(0).random((rows, columns)))
    config = GeneratorConfig.model_validate({"material": str(heights), **options})
    job = Job.prepare(config)
    entries = [entry for split in SPLITS for entry in job.shards(split)]
    open_folder(job, folder, build_manifest(job, entries, simulated(job)), False)
    for number, entry in enumerate(entries):
        queries = job.plan().draw(entry.split, entry.index, entry.rows)
        truth, rng = formula(queries), np.random.default_rng(number)
        halves = [(truth * (1 + NOISE * rng.normal(size=truth.shape))).astype(np.float32) for _ in range(2)]
        path = folder / entry.file
        write_shard(
            path,
            {
                "u": queries.u,
                "sigma": queries.sigma,
                "omega_i": queries.omega_i,
                "omega_o": queries.omega_o,
                "value_a": halves[0],
                "value_b": halves[1],
                "spp": np.full(queries.lead, job.spp(entry.split), np.float32),
            },
        )
        made = SimpleNamespace(
            value_a=halves[0].reshape(-1, 3),
            value_b=halves[1].reshape(-1, 3),
            paths=queries.sigma.size * job.spp(entry.split),
            nonfinite=0,
            lost=0,
            capped=0,
            bad_samples=(),
        )
        write_json(sidecar_of(path), _sidecar(job, entry, path, made, 0.1))
    finish(folder)
    return Dataset.open(folder)

"""Small data sets of known functions, of queries alone and of images, written as shards."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mbtf_core.data.geometry import Geometry, encode_geometry, geometry_record
from mbtf_core.data.lattice import Lattice, sigma_of_level, texel_centers
from mbtf_core.data.schema import FORMAT_NAME, GEOMETRY_NAME, MANIFEST_NAME, SCHEMA_VERSION, Queries
from mbtf_core.data.shard_files import write_shard
from mbtf_core.directions import from_projected_disk
from mbtf_core.files.atomic import write_checksummed
from mbtf_fit.config import FitConfig, build_model
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.objective.noise import NoiseModel, typical_value
from mbtf_fit.training.loop import TrainingLoop
from mbtf_fit.training.trainer import Trainer

from .datasets import write_sidecar
from .known_surfaces import geometry as known_geometry

F32 = NDArray[np.float32]
# (u, sigma, omega_i, omega_o) → (n, 3)
Function = Callable[[F32, F32, F32, F32], NDArray[np.float64]]
# Transmittance of a material with holes: (u, sigma, omega_o) → (n,)
Through = Callable[[F32, F32, F32], NDArray[np.floating]]


def random_directions(random: np.random.Generator, n: int) -> F32:
    """Unit vectors (n, 3), uniform on the projected disk up to cos 0.1."""
    radius, angle = np.sqrt(0.99 * random.random(n)), 2 * np.pi * random.random(n)
    xy = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    return from_projected_disk(xy).astype(np.float32)


def random_queries(random: np.random.Generator, n: int, lattice: Lattice) -> dict[str, F32]:
    """Queries of all levels and directions."""
    return {
        # Rounding can reach 1, which is 0 on the torus.
        "u": random.random((n, 2)).astype(np.float32) % 1,
        "sigma": sigma_of_level(lattice.finest * random.random(n)).astype(np.float32),
        "omega_i": random_directions(random, n),
        "omega_o": random_directions(random, n),
    }


def constant(value: float) -> Function:
    """The same gray everywhere."""
    return lambda u, sigma, omega_i, omega_o: np.full((len(u), 3), value)


def parallax(u: F32, sigma: F32, omega_i: F32, omega_o: F32) -> NDArray[np.float64]:
    """A wave at depth 0.05 under the reference plane, darkened by the light's cosine: positive everywhere."""
    at = u - 0.05 * omega_o[:, :2] / omega_o[:, 2:]
    fade = np.exp(-2 * (2 * np.pi * sigma) ** 2)
    wave = np.cos(2 * np.pi * at[:, 0]) * np.sin(4 * np.pi * at[:, 1]) * fade
    value = 0.1 * (1 + 0.8 * wave) * (0.2 + 0.8 * omega_i[:, 2])
    return value[:, None] * np.array([1.0, 0.8, 0.6])


def noisy_halves(
    random: np.random.Generator, value: NDArray[np.float64], noise: float
) -> dict[str, NDArray[np.float32]]:
    """Two estimates of values with independent noise."""
    return {
        f"value_{half}": (value + noise * random.standard_normal(value.shape)).astype(np.float32)
        for half in "ab"
    }


def write_splits(
    folder: Path,
    lattice: Lattice,
    splits: dict[str, Iterable[dict[str, F32]]],
    function: Function,
    halves: Callable[[NDArray[np.float64]], dict[str, F32]],
    config_hash: str,
    *,
    through: Through | None = None,
    suffix: str = ".npz",
    **more: Any,
) -> Path:
    """Write queries by split and shard with the `halves` of their values; returns the folder. The manifest
    also says `more`."""
    folder.mkdir(parents=True, exist_ok=True)
    written: dict[str, Any] = {}
    for split, shards in splits.items():
        entries = []
        for index, queries in enumerate(shards):
            lead, flat = queries["sigma"].shape, Queries(**queries).flat()
            value = function(flat.u, flat.sigma, flat.omega_i, flat.omega_o).reshape(*lead, 3)
            arrays = {**queries, **halves(value), "spp": np.full(lead, 2, np.float32)}
            if through is not None:
                seen = through(flat.u, flat.sigma, flat.omega_o)
                arrays["transmittance"] = seen.reshape(lead).astype(np.float32)
            file = folder / f"{split}-{index:05d}{suffix}"
            write_shard(file, arrays)
            write_sidecar(file, split, index, config_hash)
            entries.append({"file": file.name, "rows": lead[0]})
        rows = sum(entry["rows"] for entry in entries)
        written[split] = {"queries": rows, "shards": entries}
    manifest = {
        "format": FORMAT_NAME,
        "schema": SCHEMA_VERSION,
        "config_hash": config_hash,
        "levels": {"finest": lattice.finest},
        "tile": {"aspect": lattice.aspect},
        "geometry": None,
        "splits": written,
        "arrays": {} if through is None else {"transmittance": {}},
        **more,
    }
    write_checksummed(folder / MANIFEST_NAME, manifest)
    return folder


def write_data(
    folder: Path,
    function: Function,
    *,
    train: int = 20_000,
    test: int = 2_000,
    shards: int = 2,
    finest: int = 3,
    aspect: float = 1.0,
    noise: float = 0.0,
    suffix: str = ".npz",
    seed: int = 0,
    through: Through | None = None,
    geometry: Geometry | None = None,
) -> Path:
    """Write a data set of a known function with independent noise in both halves; returns its folder.
    `geometry` is what it says of its surface; None: a flat gray tile."""
    folder.mkdir(parents=True, exist_ok=True)
    lattice, random = Lattice(finest, aspect), np.random.default_rng(seed)
    gray = (0.5, 0.5, 0.5)
    geometry = geometry or known_geometry(lattice, np.zeros((8, 8), np.float32), color=gray)
    (folder / GEOMETRY_NAME).write_bytes(encode_geometry(geometry))
    parts = [train * (index + 1) // shards - train * index // shards for index in range(shards)]
    sizes = {"train": parts, "test": [test]}
    splits = {split: (random_queries(random, n, lattice) for n in sizes[split]) for split in sizes}
    name, halves = f"{function.__name__}-{seed}-{noise}", partial(noisy_halves, random, noise=noise)
    more: dict[str, Any] = {"layout": "shuffled", "suffix": suffix, "geometry": geometry_record(geometry)}
    more["config"] = {"light": {"width": 1.0}}
    return write_splits(folder, lattice, splits, function, halves, name, through=through, **more)


def random_images(
    random: np.random.Generator, items: int, lattice: Lattice, *, regular: bool = False
) -> dict[str, F32]:
    """Images of all levels and directions: one query per finest texel, at its center or anywhere in it."""
    rows, columns = lattice.shape()
    shape = (items, rows, columns)
    jitter = np.zeros((*shape, 2)) if regular else random.random((*shape, 2)) - 0.5
    u = texel_centers(rows, columns) + jitter / [columns, rows]
    sigma = sigma_of_level(lattice.finest * random.random(items))[:, None, None]
    omega = (random_directions(random, items)[:, None, None] for _ in range(2))
    spread = [np.broadcast_to(sigma, shape), *(np.broadcast_to(o, (*shape, 3)) for o in omega)]
    names = ("u", "sigma", "omega_i", "omega_o")
    arrays = (u, *spread)
    return {n: np.ascontiguousarray(a, np.float32) for n, a in zip(names, arrays, strict=True)}


def write_images(
    folder: Path,
    function: Function,
    *,
    train: int = 60,
    test: int = 3,
    noise: float = 0.0,
    through: Through | None = None,
) -> Path:
    """Write so many images of a known function, in two shards, with independent noise in both halves."""
    lattice, random = Lattice(3), np.random.default_rng(0)
    sizes = {"train": (train // 2, train - train // 2), "test": (test,)}
    splits = {split: (random_images(random, n, lattice) for n in sizes[split]) for split in sizes}
    name, halves = f"images-{function.__name__}-{noise}", partial(noisy_halves, random, noise=noise)
    more = {"layout": "image", "patch_size": None}
    return write_splits(folder, lattice, splits, function, halves, name, through=through, **more)


def training_queries(arrays: dict[str, F32], value: NDArray[np.floating]) -> TrainingQueries:
    """Queries with their values (n, 3), as training reads them."""
    return TrainingQueries(*(torch.from_numpy(np.asarray(a, np.float32)) for a in (*arrays.values(), value)))


def make_trainer(
    queries: TrainingQueries,
    lattice: Lattice,
    model: str = "neumip",
    noise: NoiseModel | None = None,
    **training: Any,
) -> Trainer:
    """A trainer of a fresh model on queries; without noise unless a model of it is given."""
    config = FitConfig.model_validate({"model": model, "training": training})
    scale = typical_value(queries.value.numpy())
    network = build_model(model, lattice)
    network.initialize(torch.Generator().manual_seed(0), scale)
    return Trainer(config, network, queries, noise or NoiseModel.silent(scale, lattice))


def train_fully(trainer: Trainer) -> Trainer:
    """Train until the budget is spent."""
    while not TrainingLoop([trainer]).train(10.0):
        pass
    return trainer

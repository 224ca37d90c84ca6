"""Small data sets of known functions, written as shards."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mbtf_core.data.geometry import Geometry, encode_geometry, geometry_record
from mbtf_core.data.lattice import Lattice, sigma_of_level
from mbtf_core.data.schema import GEOMETRY_NAME
from mbtf_core.directions import from_projected_disk
from mbtf_fit.config import FitConfig, build_model
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.objective.noise import NoiseModel, typical_value
from mbtf_fit.training.loop import TrainingLoop
from mbtf_fit.training.trainer import Trainer

from .datasets import write_manifest, write_part

F32 = NDArray[np.float32]
# (u, sigma, omega_i, omega_o) → (n, 3)
Function = Callable[[F32, F32, F32, F32], NDArray[np.float64]]


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
    through: Callable[[F32, F32, F32], NDArray[np.float64]] | None = None,
    geometry: Geometry | None = None,
) -> Path:
    """Write a data set of a known function with independent noise in both halves; returns its folder.

    Parameters
    ----------
    geometry : what the data set says of its surface; None: a flat gray tile
    through : transmittance at u, σ and view, of a material with holes
    """
    folder.mkdir(parents=True, exist_ok=True)
    lattice = Lattice(finest, aspect)
    random = np.random.default_rng(seed)
    geometry = geometry or flat_geometry(lattice)
    (folder / GEOMETRY_NAME).write_bytes(encode_geometry(geometry))
    config_hash = f"{function.__name__}-{seed}-{noise}"
    splits: dict[str, Any] = {}
    for split, total, count in (("train", train, shards), ("test", test, 1)):
        entries = []
        for index in range(count):
            n = total * (index + 1) // count - total * index // count
            queries = random_queries(random, n, lattice)
            halves = noisy_halves(random, function(*queries.values()), noise)
            arrays = {**queries, **halves, "spp": np.full(n, 2, np.float32)}
            if through is not None:
                seen = through(queries["u"], queries["sigma"], queries["omega_o"])
                arrays["transmittance"] = seen.astype(np.float32)
            entries.append(write_part(folder, split, index, arrays, config_hash, suffix))
        splits[split] = total, entries
    more: dict[str, Any] = {} if through is None else {"arrays": {"transmittance": {}}}
    more |= {"config": {"light": {"width": 1.0}}, "geometry": geometry_record(geometry)}
    return write_manifest(folder, "shuffled", lattice, config_hash, splits, **more)


def flat_geometry(lattice: Lattice) -> Geometry:
    """Geometry of a flat gray tile."""
    shape = Lattice(lattice.finest + 1, lattice.aspect).shape()
    heights = np.zeros((8, 8), np.float32)
    slopes, moments, color = (np.zeros((*shape, n), np.float32) for n in (2, 3, 3))
    return Geometry(heights, lattice.aspect, slopes, moments, base_color=color + np.float32(0.5))


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

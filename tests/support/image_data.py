"""Small data sets of the image layout of known functions, written as shards."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.data.lattice import Lattice, sigma_of_level, texel_centers
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan

from .datasets import write_manifest, write_part
from .fit_data import F32, Function, noisy_halves, random_directions


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
    seed: int = 0,
    patch_size: int | None = None,
    through: Callable[[F32, F32, F32], Any] | None = None,
) -> Path:
    """Write so many images of a known function, in two shards, with independent noise in both halves.

    Parameters
    ----------
    patch_size : texels along each side of an image; None: whole images
    through : transmittance at u, σ and view, of a material with holes
    """
    folder.mkdir(parents=True, exist_ok=True)
    lattice, random = Lattice(3), np.random.default_rng(seed)
    config_hash = f"images-{function.__name__}-{seed}-{noise}"
    splits: dict[str, Any] = {}
    for split, counts in (("train", (train // 2, train - train // 2)), ("test", (test,))):
        entries = []
        for index, items in enumerate(counts):
            queries = random_images(random, items, lattice)
            if patch_size is not None:
                plan = QueryPlan(lattice, LevelMixture(1, 0), 0.1, "image", seed, items, patch_size)
                queries = {name: getattr(plan.draw(split, index, items), name) for name in queries}
            shape = queries["sigma"].shape
            flat = {name: a.reshape(-1, *a.shape[3:]) for name, a in queries.items()}
            halves = noisy_halves(random, function(*flat.values()).reshape(*shape, 3), noise)
            if through is not None:
                seen = through(flat["u"], flat["sigma"], flat["omega_o"])
                halves["transmittance"] = seen.reshape(shape).astype(np.float32)
            arrays = {**queries, **halves, "spp": np.full(shape, 2, np.float32)}
            entries.append(write_part(folder, split, index, arrays, config_hash))
        splits[split] = sum(counts), entries
    more: dict[str, Any] = {} if through is None else {"arrays": {"transmittance": {}}}
    return write_manifest(folder, "image", lattice, config_hash, splits, patch_size=patch_size, **more)

"""Small data sets of the slices layout, of known functions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models.registry import MODELS
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.pytorch.networks import initialize_layers
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan, slice_directions

from .datasets import write_manifest, write_part
from .fit_data import F32, Function, noisy_halves


def spots(u: F32, sigma: F32, omega_i: F32, omega_o: F32) -> Any:
    """A base and a highlight that vary over the tile, averaged over the footprint: smooth in everything."""
    half = omega_i + omega_o
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    fade = np.exp(-0.5 * (2 * np.pi * sigma) ** 2)
    base = 0.1 * (1.0 + 0.5 * fade * np.sin(2 * np.pi * u[:, 1]))
    highlight = 0.2 * (1.0 + 0.5 * fade * np.cos(2 * np.pi * u[:, 0])) * half[:, 2] ** 10
    return (base + highlight)[:, None] * np.array([1.0, 0.8, 0.5])


def write_slices(
    folder: Path,
    function: Function = spots,
    *,
    finest: int = 3,
    aspect: float = 1.0,
    lights: int = 10,
    test: int = 2000,
    noise: float = 0.0,
    seed: int = 0,
    rows: int = 40,
    through: Callable[[F32], F32] | None = None,
    change: Callable[[dict[str, F32]], None] | None = None,
) -> Path:
    """Write a data set of `lights` lights and views per texel with independent noise in both halves; returns
    its folder. `through`: the transmittance at u, of a material with holes; `change` alters the arrays of the
    first shard."""
    folder.mkdir(parents=True)
    lattice = Lattice(finest, aspect)
    directions = slice_directions("spiral", lights, 0.2)
    plan = QueryPlan(lattice, LevelMixture(0.6, 0.4), 0.2, "slices", seed, rows, None, directions)
    random = np.random.default_rng(seed)
    config_hash = f"{function.__name__}-{seed}-{noise}-{lights}"
    splits: dict[str, Any] = {}
    for split, total in (("train", lattice.texels()), ("test", test)):
        entries = []
        for index, start in enumerate(range(0, total, rows)):
            queries = plan.draw(split, index, min(rows, total - start))
            flat, lead = queries.flat(), queries.lead
            value = function(flat.u, flat.sigma, flat.omega_i, flat.omega_o).reshape(*lead, 3)
            arrays: dict[str, F32] = {**vars(queries), **noisy_halves(random, value, noise)}
            arrays["spp"] = np.full(lead, 2, np.float32)
            if through is not None:
                arrays["transmittance"] = through(queries.u)
            if change is not None and (split, index) == ("train", 0):
                change(arrays)
            entries.append(write_part(folder, split, index, arrays, config_hash))
        splits[split] = total, entries
    more: dict[str, Any] = {} if through is None else {"arrays": {"transmittance": {}}}
    return write_manifest(folder, "slices", lattice, config_hash, splits, slice_size=lights**2, **more)


def prepared(material: NeuralMaterial, name: str, pairs: int, device: torch.device) -> Any:
    """The model of a material, with an encoder of slices at so many pairs."""
    model: Any = MODELS[name](material)
    model.encoder = model._encoder(pairs)
    generator = torch.Generator().manual_seed(0)
    for network in model.encoder.children():
        initialize_layers(network, generator)
    model.encoder.to(device)
    return model

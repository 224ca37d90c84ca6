"""Small data sets of the slices layout, of known functions."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models.registry import MODELS
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.pytorch.networks import initialize_layers
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan, slice_directions

from .fit_data import F32, Function, Through, noisy_halves, write_splits


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
    through: Through | None = None,
) -> Path:
    """Write a data set of `lights` lights and views per texel with independent noise in both halves; returns
    its folder."""
    lattice, rows = Lattice(finest, aspect), 40
    directions = slice_directions("spiral", lights, 0.2)
    plan = QueryPlan(lattice, LevelMixture(0.6, 0.4), 0.2, "slices", 0, rows, None, directions)
    splits = {
        split: [
            vars(plan.draw(split, index, min(rows, total - rows * index)))
            for index in range(math.ceil(total / rows))
        ]
        for split, total in (("train", lattice.texels()), ("test", test))
    }
    halves = partial(noisy_halves, np.random.default_rng(0), noise=noise)
    name, layout = f"{function.__name__}-{noise}-{lights}", {"layout": "slices", "slice_size": lights**2}
    return write_splits(folder, lattice, splits, function, halves, name, through=through, **layout)


def prepared(material: NeuralMaterial, name: str, pairs: int, device: torch.device) -> Any:
    """The model of a material, with an encoder of slices at so many pairs."""
    model: Any = MODELS[name](material)
    model.encoder = model._encoder(pairs)
    generator = torch.Generator().manual_seed(0)
    for network in model.encoder.children():
        initialize_layers(network, generator)
    model.encoder.to(device)
    return model

"""Material folders of known weights, exported without training."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load_file, save_file

from mbtf_core.data.lattice import Lattice
from mbtf_core.files.atomic import file_sha256
from mbtf_fit.config import FitConfig, build_model
from mbtf_fit.material.material import Material, export
from mbtf_fit.material.sampler import Sampler
from mbtf_fit.material.transmittance import Transmittance
from mbtf_fit.ops import Network
from mbtf_fit.ops.operation import input_sizes
from mbtf_fit.ops.sampler import sampler_of, sampler_sizes
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.surface.known import KnownSurface

from .known_surfaces import geometry, rough_surface

TRAINING = {"steps": 0, "batch": 1, "seconds": 0.0, "device": "cpu", "threads": 1, "errors": {}}


def write_material(
    folder: Path,
    *,
    model: str = "neumip",
    network: dict[str, Any] | None = None,
    finest: int = 3,
    aspect: float = 1.0,
    constant: tuple[float, float, float] | None = None,
    weights: dict[str, torch.Tensor] | None = None,
    contrast: float = 0.5,
    brightness: float = 0.3,
    seed: int = 0,
    transmittance: Transmittance | None = None,
    glossy: bool = True,
    coated: bool = False,
    known: KnownSurface | None = None,
    sampled: bool = False,
    **data: Any,
) -> Material:
    """Write a material of random weights that all matter, and return it as read back.

    Parameters
    ----------
    constant : the value, in 1/sr, everywhere, in place of random weights; for models of three outputs. Of
        `relief` it is that of the known surface alone
    weights : tensors by name that replace those of the model
    contrast : standard deviation of the features
    brightness : mean of all biases
    transmittance : None for an opaque material
    glossy, coated : whether the known surface of `relief` has a glossy lobe, and a clear coat
    known : another known surface
    sampled : whether it has a sampler, of random weights
    data : what material.json states of the data set
    """
    config = FitConfig.model_validate({"model": model, "network": network or {}})
    torch.manual_seed(seed)
    lattice = Lattice(finest, aspect)
    built = build_model(model, lattice, **(network or {}))
    built.initialize(torch.Generator().manual_seed(seed), 0.2)
    if built.tracing is not None:
        rough = rough_surface(lattice, glossy=glossy, coated=coated)
        built.know(known or (rough if constant is None else flat(lattice, constant)))
    tensors = built.weights()
    for name, tensor in tensors.items():
        if "texture" in name or "pyramid" in name:
            tensors[name] = contrast * torch.randn_like(tensor)
        elif "bias" in name:
            tensors[name] = brightness + 0.1 * torch.randn_like(tensor)
        elif name == "depth_weights":
            tensors[name] = 0.5 + torch.rand_like(tensor)
    last = max(
        (int(n) for name in tensors if name.startswith("decoder.") and (n := name.split(".")[1]).isdigit()),
        default=0,
    )
    if built.tracing is not None:
        # Few values are 0.
        tensors[f"decoder.{last}.weight"] *= 0.3
    if constant is not None:
        tensors["unit"] = torch.ones(())
        tensors[f"decoder.{last}.weight"] = torch.zeros_like(tensors[f"decoder.{last}.weight"])
        own = torch.log1p(torch.tensor(constant, dtype=torch.float32))
        # With a gate of 1.
        tensors[f"decoder.{last}.bias"] = own if built.tracing is None else torch.zeros(4)
    tensors |= weights or {}
    built.load_weights(tensors)
    folder.mkdir(parents=True, exist_ok=True)
    stated = {"hash": "0" * 64, **data}
    sampler = random_sampler(built, seed) if sampled else None
    return export(
        built,
        config,
        folder,
        data=stated,
        training=TRAINING,
        transmittance=transmittance,
        sampler=sampler,
    )


def random_sampler(model: NeuralMaterial, seed: int) -> Sampler:
    """A sampler whose mixtures vary much with all inputs."""
    generator = torch.Generator().manual_seed(seed)
    channels = 0 if model.surface is None else model.surface.maps[0].shape[-1]
    operations = sampler_of(model.stored_operations(), channels)
    network = operations[-1]
    assert isinstance(network, Network)
    sizes = sampler_sizes(model.stored_operations(), operations)
    tensors = {}
    for k, (inputs, outputs) in enumerate(pairwise(network.widths(sum(input_sizes(network, sizes))))):
        weight = torch.randn((outputs, inputs), generator=generator) / inputs**0.5
        tensors |= {f"sampler.{k}.weight": weight, f"sampler.{k}.bias": torch.zeros(outputs)}
    tensors["sampler.2.weight"] *= 0.5
    tensors["sampler.2.bias"] = torch.tensor([-1.0, 0.3, -1.5, 0.1, -0.1, 0.5])
    return Sampler(operations, tensors)


def flat(lattice: Lattice, value: tuple[float, float, float]) -> KnownSurface:
    """A flat Lambert tile of a value in 1/sr, under a delta light."""
    r, g, b = (math.pi * c for c in value)
    heights = np.zeros(lattice.shape(), np.float32)
    return KnownSurface.of(geometry(lattice, heights, color=(r, g, b)), lattice, 0.0)


def replace_tensors(folder: Path, changes: dict[str, np.ndarray | None]) -> None:
    """Change tensors of a material, or remove them (None), and restore its digest."""
    path = folder / "weights.safetensors"
    tensors = load_file(path)
    for name, tensor in changes.items():
        del tensors[name]
        if tensor is not None:
            tensors[name] = np.ascontiguousarray(tensor)
    save_file(tensors, path)
    description = json.loads((folder / "material.json").read_text())
    description["weights"]["sha256"] = file_sha256(path)
    (folder / "material.json").write_text(json.dumps(description))


def net(**options: Any) -> dict[str, Any]:
    """The option of :func:`write_material` for an architecture."""
    return {"network": options}


def deviation(found: np.ndarray, wanted: np.ndarray) -> float:
    """Largest difference as a share of max(value, mean)."""
    return float((np.abs(found - wanted) / np.maximum(wanted, wanted.mean())).max())

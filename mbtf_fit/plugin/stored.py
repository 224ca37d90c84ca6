"""A material folder as NumPy arrays: what a renderer needs of it, checked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.errors import InputError, reason
from mbtf_gen.levels import Lattice

from ..material_format import CONFORMANCE, DESCRIPTION_NAME, check_conformance, read_description

F32 = NDArray[np.float32]
# (weight (outputs, inputs), bias (outputs,)) of each layer.
Layers = list[tuple[F32, F32]]
MODELS = ("neumip", "neumip-baseline")
# Options of `config.network` that change how a value is computed, and the choices that are implemented here;
# sizes may be anything.
_SIZES = ("channels", "width", "layers")
_CHOICES: dict[str, tuple[object, ...]] = {}


@dataclass(frozen=True)
class StoredMaterial:
    """The weights of a fitted material.

    Attributes
    ----------
    folder : where it lies
    lattice : texel grids of the tile
    digest : SHA-256 of the weights' file
    pyramid : (rows, columns, channels) of each level, coarsest first
    decoder : layers of the network that gives the value
    offset_texture, offset_network : those of the neural offset; None for a model without
    unit : factor of the value, 1/sr
    conformance : queries ``u``, ``sigma``, ``omega_i``, ``omega_o`` and their values ``rgb`` (n, 3)
    """

    folder: Path
    lattice: Lattice
    digest: str
    pyramid: list[F32]
    decoder: Layers
    offset_texture: F32 | None
    offset_network: Layers | None
    unit: float
    conformance: dict[str, F32]


def read_material(folder: str | Path) -> StoredMaterial:
    """Read a material folder, without PyTorch.

    Raises
    ------
    InputError : missing, damaged, of another schema, or of a model or option that no plugin exists for
    """
    folder = Path(folder)
    description, weights = read_description(folder)
    place = folder / DESCRIPTION_NAME
    _refuse_unknown(description, place)
    tensors = _read_tensors(weights)
    lattice = Lattice(description["levels"]["finest"], description["tile"]["aspect"])
    stored = {name: tensors[f"conformance.{name}"] for name in CONFORMANCE if f"conformance.{name}" in tensors}
    conformance = check_conformance(stored, description, weights)
    reader = _Reader(tensors, weights)
    pyramid = [reader.texture(f"pyramid.{s}", lattice.shape(s)) for s in range(lattice.finest + 1)]
    channels = pyramid[0].shape[2]
    offset_texture, offset_network = None, None
    if description["model"] == "neumip":
        offset_texture = reader.texture("offset_texture.0", lattice.shape())
        offset_network = reader.layers("offset_network", offset_texture.shape[2] + 2, 1)
    return StoredMaterial(
        folder,
        lattice,
        str(description["weights"]["sha256"]),
        pyramid,
        reader.layers("decoder", channels + 4, 3),
        offset_texture,
        offset_network,
        float(reader.take("unit", ())),
        conformance,
    )


def _refuse_unknown(description: dict[str, Any], place: Path) -> None:
    model = description["model"]
    if model not in MODELS:
        raise InputError(
            f"the renderer's plugin cannot evaluate the model '{model}'",
            where=place,
            cure=f"it knows {' and '.join(MODELS)}",
        )
    network = description["config"].get("network", {})
    for name, value in network.items() if isinstance(network, dict) else ():
        if name not in _SIZES and value not in _CHOICES.get(name, ()):
            raise InputError(
                f"the renderer's plugin cannot evaluate a network with {name}: {value}",
                where=place,
                cure="fit the material without it",
            )


def _read_tensors(path: Path) -> dict[str, NDArray[Any]]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, TypeError) as error:
        raise InputError(f"cannot be read as tensors ({reason(error)})", where=path) from None


@dataclass(frozen=True)
class _Reader:
    tensors: dict[str, NDArray[Any]]
    path: Path

    def take(self, name: str, shape: tuple[int | None, ...]) -> F32:
        """A tensor of a shape; None stands for any size."""
        array = self.tensors.get(name)
        if array is None:
            raise InputError(f"lacks the tensor '{name}'", where=self.path)
        if len(shape) != array.ndim or any(s is not None and s != t for s, t in zip(shape, array.shape, strict=True)):
            raise InputError(f"its tensor '{name}' has the shape {array.shape}", where=self.path)
        out: F32 = np.array(array, np.float32, order="C")
        if not np.isfinite(out).all():
            raise InputError(f"its tensor '{name}' holds numbers that are not finite", where=self.path)
        return out

    def texture(self, name: str, shape: tuple[int, int]) -> F32:
        return self.take(name, (*shape, None))

    def layers(self, name: str, inputs: int, outputs: int) -> Layers:
        out: Layers = []
        while f"{name}.{len(out)}.weight" in self.tensors or not out:
            weight = self.take(f"{name}.{len(out)}.weight", (None, inputs))
            out.append((weight, self.take(f"{name}.{len(out)}.bias", (len(weight),))))
            inputs = len(weight)
        if inputs != outputs:
            raise InputError(f"its network '{name}' has {inputs} outputs, not {outputs}", where=self.path)
        return out

"""A material folder as NumPy arrays: what a renderer needs of it, checked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.config_file import build
from mbtf_core.errors import InputError, reason
from mbtf_core.lattice import Lattice
from mbtf_fit.config import FitConfig, NetworkSection
from mbtf_fit.material.format import CONFORMANCE, DESCRIPTION_NAME, check_conformance, read_description
from mbtf_fit.material.transmittance import read_transmittance

F32 = NDArray[np.float32]
# (weight (outputs, inputs), bias (outputs,)) of each layer.
Layers = list[tuple[F32, F32]]


@dataclass(frozen=True)
class StoredMaterial:
    """The weights of a fitted material.

    Attributes
    ----------
    folder : where it lies
    lattice : texel grids of the tile
    network : its architecture
    pyramid : (rows, columns, channels) of each level, coarsest first
    decoder : layers of the network that gives the value
    offset_texture, offset_network : those of the neural offset; None without one
    unit : factor of the value, 1/sr
    calibration : (2, levels, knots, 3) factors by light's and view's elevation; None where there are none
    transmittance : (rows, columns, 6) coefficients of each level; None for an opaque material
    conformance : queries ``u``, ``sigma``, ``omega_i``, ``omega_o`` and their values ``rgb`` (n, 3)
    """

    folder: Path
    lattice: Lattice
    network: NetworkSection
    pyramid: list[F32]
    decoder: Layers
    offset_texture: F32 | None
    offset_network: Layers | None
    unit: float
    calibration: F32 | None
    transmittance: list[F32] | None
    conformance: dict[str, F32]


def read_material(folder: str | Path) -> StoredMaterial:
    """Read a material folder, without PyTorch.

    Raises
    ------
    InputError : missing, damaged, of another schema, or of a model or option that no plugin exists for
    """
    folder = Path(folder)
    description, weights = read_description(folder)
    network = _supported(description, folder / DESCRIPTION_NAME)
    tensors = _read_tensors(weights)
    lattice = Lattice(description["levels"]["finest"], description["tile"]["aspect"])
    stored = {
        name: tensors[f"conformance.{name}"] for name in CONFORMANCE if f"conformance.{name}" in tensors
    }
    conformance = check_conformance(stored, description, weights)
    reader = _Reader(tensors, weights)
    transmittance = read_transmittance(folder, description)
    pyramid = [reader.texture(f"pyramid.{s}", lattice.shape(s)) for s in range(lattice.finest + 1)]
    channels = pyramid[0].shape[2]
    offset_texture, offset_network = None, None
    if network.offset != "none":
        offset_texture = reader.texture("offset_texture.0", lattice.shape())
        answers = 1 if network.offset == "depth" else 2
        offset_network = reader.layers("offset_network", offset_texture.shape[2] + 2, answers)
    features = channels * (2 if network.blending == "concatenate" else 1)
    directions = 2 * _size(3 if network.encoding.direction_xyz else 2, network.encoding.direction, network)
    position = _size(2, network.encoding.position, network) if network.encoding.position else 0
    return StoredMaterial(
        folder,
        lattice,
        network,
        pyramid,
        reader.layers("decoder", features + position + directions, network.output_channels),
        offset_texture,
        offset_network,
        float(reader.take("unit", ())),
        reader.take("calibration", (2, lattice.finest + 1, None, 3)) if "calibration" in tensors else None,
        None if transmittance is None else transmittance.levels,
        conformance,
    )


def _size(coordinates: int, bands: int, network: NetworkSection) -> int:
    """Numbers that encode so many coordinates."""
    return coordinates * (2 * bands + network.encoding.raw) if bands else coordinates


def _supported(description: dict[str, Any], place: Path) -> NetworkSection:
    """The architecture, or a refusal."""
    # How it was trained is no concern of a renderer.
    named = {key: description["config"][key] for key in ("model", "network") if key in description["config"]}
    config = build(FitConfig, named, source=str(place))
    if config.network.decoder != "mlp":
        raise InputError(
            f"the renderer's plugin cannot evaluate '{config.model}', which looks at neighboring queries",
            where=place,
            hint="fit the model neumip or neumip-baseline to the same shards",
        )
    return config.network


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
        if len(shape) != array.ndim or any(
            s is not None and s != t for s, t in zip(shape, array.shape, strict=True)
        ):
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

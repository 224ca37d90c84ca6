"""A material folder as NumPy arrays, validated, for renderers."""

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
from mbtf_fit.models.constants import direction_size, position_size

F32 = NDArray[np.float32]
# (weight (outputs, inputs), bias (outputs,)) of each layer.
Layers = list[tuple[F32, F32]]


@dataclass(frozen=True)
class StoredMaterial:
    """Weights of a fitted material as float32 arrays.

    Attributes
    ----------
    folder : Path
        Folder of the material.
    lattice : Lattice
        Texel grids of the tile.
    network : NetworkSection
        Architecture.
    pyramid : list of (rows, columns, channels) arrays
        Feature textures, coarsest level first.
    decoder : list of (weight, bias)
        Layers of the decoder: (outputs, inputs) and (outputs,) arrays.
    offset_texture : (rows, columns, channels) array or None
        Texture of the neural offset.
    offset_network : list of (weight, bias) or None
        Layers of the offset network.
    unit : float
        Factor of the value, in 1/sr.
    calibration : (2, levels, knots, 3) array or None
        Calibration factors by elevation of light and of view.
    transmittance : list of (rows, columns, 6) arrays or None
        Coefficients of the transmittance; None for an opaque material.
    conformance : dict
        Queries ``u``, ``sigma``, ``omega_i``, ``omega_o`` and their values ``rgb`` (n, 3).
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

    Parameters
    ----------
    folder : str or Path
        Folder made by ``mbtf-fit``.

    Returns
    -------
    StoredMaterial

    Raises
    ------
    InputError
        The folder is missing, corrupt, of another schema, or of an unsupported model.
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
        outputs = 1 if network.offset == "depth" else 2
        offset_network = reader.layers("offset_network", offset_texture.shape[2] + 2, outputs)
    features = channels * (2 if network.blending == "concatenate" else 1)
    encoded = position_size(network.encoding) + 2 * direction_size(network.encoding)
    return StoredMaterial(
        folder,
        lattice,
        network,
        pyramid,
        reader.layers("decoder", features + encoded, network.output_channels),
        offset_texture,
        offset_network,
        float(reader.take("unit", ())),
        reader.take("calibration", (2, lattice.finest + 1, None, 3)) if "calibration" in tensors else None,
        None if transmittance is None else transmittance.levels,
        conformance,
    )


def _supported(description: dict[str, Any], path: Path) -> NetworkSection:
    """The architecture.

    Raises
    ------
    InputError : the plugin does not support it
    """
    # A renderer does not depend on the options of training.
    named = {key: description["config"][key] for key in ("model", "network") if key in description["config"]}
    config = build(FitConfig, named, source=str(path))
    if config.network.decoder != "mlp":
        raise InputError(
            f"the renderer's plugin does not support the inception decoder of '{config.model}'",
            where=path,
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

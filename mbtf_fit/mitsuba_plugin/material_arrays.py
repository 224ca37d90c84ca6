"""A material folder as NumPy arrays, validated, for renderers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.config.settings import build
from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit.config import FitConfig
from mbtf_fit.material.format import (
    DEFAULT_MIN_COS,
    DESCRIPTION_NAME,
    check_conformance,
    lattice_of,
    read_description,
)
from mbtf_fit.material.storage import read_tensors
from mbtf_fit.material.transmittance import read_transmittance
from mbtf_fit.ops import read_operations
from mbtf_fit.ops.constants import (
    AZIMUTHS,
    DIELECTRIC,
    DIFFUSE_CHANNELS,
    GLOSSY_CHANNELS,
    HEIGHTS,
    HORIZONS,
    LIGHT_WIDTH,
    MAPS,
    STATISTICS,
    directions_size,
    hint_size,
    position_size,
)
from mbtf_fit.sections import NetworkSection

F32 = NDArray[np.float32]
# (weight (outputs, inputs), bias (outputs,)) of each layer.
Layers = list[tuple[F32, F32]]


@dataclass(frozen=True)
class StoredSurface:
    """Known surface of the model `relief` as float32 arrays.

    Attributes
    ----------
    heights : (H, W) heights in tile widths
    maps : filtered maps (rows, columns, 6 or 8) of the levels 0 to k + 1
    horizons : means of the horizons' angles, then of their squares, (rows, columns, 2·azimuths) of the levels
        0 to k
    depth_weights : (levels,) weights of the displacement
    light_width : RMS angle per axis of the light kernel, in radians
    dielectric : F0 where the surface is no metal
    """

    heights: F32
    maps: list[F32]
    horizons: list[F32]
    depth_weights: F32
    light_width: float
    dielectric: float


@dataclass(frozen=True)
class StoredMaterial:
    """Weights of a fitted material as float32 arrays.

    Attributes
    ----------
    folder, network : the material's folder and architecture
    lattice : texel grids of the tile
    min_cos : smallest cosine of the directions in the data
    sliced : whether it is one of the models that encode angular slices
    pyramid : feature textures (rows, columns, channels), coarsest level first
    decoder : layers of the decoder
    offset_texture, offset_network : those of the neural offset; None for a material without
    unit : factor of the value, in 1/sr
    calibration : factors (2, levels, knots, 3) by elevation of light and of view, or None
    surface : heights and maps of the model `relief`, or None
    transmittance : coefficients (rows, columns, 6) by level; None for an opaque material
    conformance : queries ``u``, ``sigma``, ``omega_i``, ``omega_o`` and their values ``rgb`` (n, 3)
    """

    folder: Path
    lattice: Lattice
    min_cos: float
    network: NetworkSection
    sliced: bool
    pyramid: list[F32]
    decoder: Layers
    offset_texture: F32 | None
    offset_network: Layers | None
    unit: float
    calibration: F32 | None
    surface: StoredSurface | None
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
    # A renderer does not depend on the options of training.
    named = {key: description["config"][key] for key in ("model", "network") if key in description["config"]}
    config = build(FitConfig, named, source=str(folder / DESCRIPTION_NAME))
    network, lattice = config.network, lattice_of(description)
    if network.decoder != "mlp":
        raise InputError(
            f"the renderer's plugin does not support the inception decoder of '{config.model}'",
            where=folder / DESCRIPTION_NAME,
            hint="fit the model neumip or neumip-baseline to the same shards",
        )
    tensors, _ = read_tensors(weights, "np")
    conformance = check_conformance(tensors, description, weights)
    reader = _Reader(tensors, weights)
    transmittance = read_transmittance(folder, description)
    finer = network.oversampling.bit_length() - 1
    grids = Lattice(lattice.finest + finer, lattice.aspect)
    pyramid = [
        reader.take(f"pyramid.{s}", (*grids.shape(s + finer), None)) for s in range(lattice.finest + 1)
    ]
    channels = pyramid[0].shape[2]
    offset_texture, offset_network = None, None
    if network.offset != "none":
        offset_texture = reader.take("offset_texture.0", (*lattice.shape(), None))
        outputs = 1 if network.offset == "depth" else 2
        offset_network = reader.layers("offset_network", offset_texture.shape[2] + 2, outputs)
    features = channels * (2 if network.blending == "concatenate" else 1)
    inputs = features + position_size(network.encoding) + directions_size(network.encoding)
    outputs = network.output_channels
    kinds = {op.kind() for op in read_operations(description["operations"])}
    sliced = "standardize" in kinds
    if sliced:
        inputs -= STATISTICS
    surface = None
    if "trace" in kinds:
        inputs, outputs = inputs + hint_size(network), outputs + network.relief.gate
        surface = _surface(reader, lattice)
    return StoredMaterial(
        folder,
        lattice,
        description["data"].get("min_cos", DEFAULT_MIN_COS),
        network,
        sliced,
        pyramid,
        reader.layers("decoder", inputs, outputs),
        offset_texture,
        offset_network,
        float(reader.take("unit", ())),
        reader.take("calibration", (2, lattice.finest + 1, None, 3)) if "calibration" in tensors else None,
        surface,
        None if transmittance is None else transmittance.levels,
        conformance,
    )


def _surface(reader: _Reader, lattice: Lattice) -> StoredSurface:
    levels = range(lattice.finest + 2)
    finer = Lattice(lattice.finest + 1, lattice.aspect)
    maps = [reader.take(f"{MAPS}.{s}", (*finer.shape(s), None)) for s in levels]
    if {level.shape[2] for level in maps} not in ({DIFFUSE_CHANNELS}, {GLOSSY_CHANNELS}):
        raise InputError(
            f"its tensors '{MAPS}' have neither {DIFFUSE_CHANNELS} nor {GLOSSY_CHANNELS} channels",
            where=reader.path,
        )
    heights = reader.take(HEIGHTS, (None, None, 1))[..., 0]
    if heights.size == 0 or heights.max() > 0:
        fault = "is empty" if heights.size == 0 else "has heights above the reference plane"
        raise InputError(f"its tensor '{HEIGHTS}' {fault}", where=reader.path)
    return StoredSurface(
        heights,
        maps,
        [reader.take(f"{HORIZONS}.{s}", (*lattice.shape(s), 2 * AZIMUTHS)) for s in levels[:-1]],
        reader.take("depth_weights", (lattice.finest + 1,)),
        float(reader.take(LIGHT_WIDTH, ())),
        float(reader.take(DIELECTRIC, ())),
    )


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
            s not in (None, t) for s, t in zip(shape, array.shape, strict=True)
        ):
            raise InputError(f"its tensor '{name}' has the shape {array.shape}", where=self.path)
        out: F32 = np.array(array, np.float32, order="C")
        if not np.isfinite(out).all():
            raise InputError(f"its tensor '{name}' holds numbers that are not finite", where=self.path)
        return out

    def layers(self, name: str, inputs: int, outputs: int) -> Layers:
        out: Layers = []
        while f"{name}.{len(out)}.weight" in self.tensors or not out:
            weight = self.take(f"{name}.{len(out)}.weight", (None, inputs))
            out.append((weight, self.take(f"{name}.{len(out)}.bias", (len(weight),))))
            inputs = len(weight)
        if inputs != outputs:
            raise InputError(f"its network '{name}' has {inputs} outputs, not {outputs}", where=self.path)
        return out

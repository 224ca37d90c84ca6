"""Exports for other programs: textures as EXR, networks as a list of layers in JSON, half precision."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import write_text, write_through
from mbtf_fit.material.material import Material, conformance_values, describe_model
from mbtf_fit.material.transmittance import FORMULA
from mbtf_fit.ops import Inception, Network
from mbtf_fit.ops.constants import DIELECTRIC, LIGHT_WIDTH

TEXTURES_NAME, LAYERS_NAME = "textures.exr", "layers.json"
FORMAT_NAME = "mbtf-layers"
SCHEMA_VERSION = 3
# Name of the parts of the transmittance, before the level.
TRANSMITTANCE_PART = "transmittance."


@dataclass(frozen=True)
class HalfError:
    """Difference of half precision from single precision on the conformance queries.

    Attributes
    ----------
    count : queries
    largest : largest absolute difference, in 1/sr
    rms : root mean square difference, in 1/sr
    relative : that over the root mean square value; None where all values are 0
    """

    count: int
    largest: float
    rms: float
    relative: float | None

    def __str__(self) -> str:
        share = "" if self.relative is None else f" ({self.relative:.2g} of the rms value)"
        return (
            f"half precision: rms error {self.rms:.2g} 1/sr{share}, largest {self.largest:.2g} 1/sr, against "
            f"single precision on {self.count} conformance queries"
        )


def _round_to_half(name: str, tensor: Tensor) -> Tensor:
    """A tensor rounded to 16-bit floats, in single precision; single numbers stay as they are."""
    if tensor.ndim == 0:
        return tensor
    rounded = tensor.half().float()
    if not bool(rounded.isfinite().all()):
        raise InputError(
            f"'{name}' holds {float(tensor.abs().max()):.3g}, beyond half precision (65504)",
            hint="export it in single precision",
        )
    return rounded


def to_half(material: Material) -> tuple[Material, HalfError]:
    """The material with all weights and texels rounded to 16 bits, and the rounding error. Arithmetic stays
    in single precision; the conformance values become those of the rounded material.

    Raises
    ------
    InputError : a number is beyond half precision
    """
    model = material.model.empty_copy()
    model.load_weights({name: _round_to_half(name, t) for name, t in material.model.weights().items()})
    transmittance = material.transmittance
    if transmittance is not None:
        levels = enumerate(map(torch.from_numpy, transmittance.levels))
        halves = [_round_to_half(f"{TRANSMITTANCE_PART}{s}", texels).numpy() for s, texels in levels]
        transmittance = replace(transmittance, levels=halves)
    before = material.conformance["rgb"].astype(np.float64)
    after = conformance_values(model, material.conformance)
    difference = after.astype(np.float64) - before
    rms, power = float(np.sqrt((difference**2).mean())), float(np.sqrt((before**2).mean()))
    error = HalfError(len(before), float(np.abs(difference).max()), rms, rms / power if power else None)
    conformance = {**material.conformance, "rgb": after}
    return replace(material, model=model, conformance=conformance, transmittance=transmittance), error


def channel_names(part: str, count: int) -> list[str]:
    """``f0``, ``f1``, …, with as many digits as the last one has, so that their order is that of the
    features; ``c0``, … of the transmittance's coefficients."""
    digits = len(str(count - 1))
    letter = "c" if part.startswith(TRANSMITTANCE_PART) else "f"
    return [f"{letter}{k:0{digits}d}" for k in range(count)]


def texture_parts(material: Material) -> dict[str, Any]:
    """Part → texture (rows, columns, channels), coarsest level first: ``pyramid.0``, …,
    ``offset_texture.0``, ``transmittance.0``, …"""
    weights, transmittance = material.model.weights(), material.transmittance
    parts = {name: tensor.cpu().numpy() for name, tensor in weights.items() if tensor.ndim == 3}
    levels = [] if transmittance is None else transmittance.levels
    return parts | {f"{TRANSMITTANCE_PART}{s}": texels for s, texels in enumerate(levels)}


def write_textures(material: Material, path: Path, *, half: bool = False) -> None:
    """Write all textures as one EXR file, a part per level and a channel per feature, losslessly compressed;
    row 0 is the top, the side ``v → 1``.

    All parts share one display window, that of the finest level, as the format asks.

    Parameters
    ----------
    half : store 16-bit floats; the material is one of :func:`to_half`

    Raises
    ------
    PartialError : the disk is full or the folder cannot be written
    """
    import OpenEXR

    rows, columns = material.lattice.shape()
    kind = np.float16 if half else np.float32
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "displayWindow": ((0, 0), (columns - 1, rows - 1)),
        "mbtf.model": material.model.name,
    }
    parts = []
    for name, texture in texture_parts(material).items():
        names = channel_names(name, texture.shape[2])
        channels = {c: np.ascontiguousarray(texture[..., k], kind) for k, c in enumerate(names)}
        parts.append(OpenEXR.Part(dict(header), channels, name=name))
    write_through(path, lambda temporary: OpenEXR.File(parts).write(str(temporary)))


def _numbers(array: Any, half: bool = False) -> Any:
    """Nested lists of decimals that single precision reads as exactly these numbers."""
    stored = np.asarray(array, np.float32)
    if stored.ndim == 0:
        # 16-bit floats have few enough digits to be written out.
        return float(stored) if half else float(str(stored[()]))
    return [_numbers(row, half) for row in stored]


def _layers(material: Material, half: bool) -> dict[str, list[dict[str, Any]]]:
    """Network → its layers in order, each with name, shape, activation, weight and bias."""
    weights = material.model.weights()
    out: dict[str, list[dict[str, Any]]] = {}
    for op in material.model.operations:
        if not isinstance(op, Network | Inception):
            continue
        network = op.weights
        names = [n for n in weights if n.startswith(f"{network}.") and n.endswith(".weight")]
        for name in names:
            weight, layer = weights[name].cpu(), name.removesuffix(".weight")
            dense = weight.ndim == 2
            out.setdefault(network, []).append(
                {
                    "name": layer,
                    "type": "dense" if dense else "convolution",
                    "inputs": weight.shape[1],
                    "outputs": weight.shape[0],
                    **({} if dense else {"size": weight.shape[2]}),
                    "activation": "none" if name == names[-1] else op.activation,
                    "weight": _numbers(weight, half),
                    "bias": _numbers(weights[f"{layer}.bias"].cpu(), half),
                }
            )
    return out


def _surface_numbers(material: Material, half: bool) -> dict[str, Any]:
    """Numbers of a known surface that are no textures."""
    weights = material.model.weights()
    names = (name for name in ("depth_weights", LIGHT_WIDTH, DIELECTRIC) if name in weights)
    return {name: _numbers(weights[name].cpu(), half) for name in names}


def write_layers(material: Material, path: Path, *, half: bool = False) -> None:
    """Write everything but the textures: layers, operations, conventions as text, shapes, and the
    conformance queries with their expected values, that of the transmittance included.

    Parameters
    ----------
    half : numbers are 16-bit floats; the material is one of :func:`to_half`

    Raises
    ------
    PartialError : the disk is full or the folder cannot be written
    """
    parts = {
        name: {"shape": list(t.shape), "channels": channel_names(name, t.shape[2])}
        for name, t in texture_parts(material).items()
    }
    calibration = material.model.weights().get("calibration")
    expected, transmittance = dict(material.conformance), material.transmittance
    if transmittance is not None:
        expected["transmittance"] = transmittance.evaluate(*(expected[k] for k in ("u", "sigma", "omega_o")))
    document = {
        "format": FORMAT_NAME,
        "schema": SCHEMA_VERSION,
        "precision": "float16" if half else "float32",
        **describe_model(material.model),
        "unit": _numbers(material.model.unit.cpu()),
        "textures": {"file": TEXTURES_NAME, "parts": parts},
        "networks": _layers(material, half),
        **_surface_numbers(material, half),
        **({} if calibration is None else {"calibration": _numbers(calibration.cpu(), half)}),
        **({} if transmittance is None else {"transmittance": FORMULA}),
        "conformance": {
            **{name: _numbers(array) for name, array in expected.items()},
            "tolerance": material.description["conformance"]["tolerance"],
        },
    }
    write_text(path, json.dumps(document, indent=1))

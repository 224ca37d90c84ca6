"""Networks as a plain list of layers in JSON, for shaders and renderers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from mbtf_core.atomic import write_text
from mbtf_core.shard_schema import CONVENTIONS
from mbtf_fit.material.export.textures import TEXTURES_NAME, channel_names, texture_parts
from mbtf_fit.material.format import MATERIAL_CONVENTIONS
from mbtf_fit.material.material import Material
from mbtf_fit.material.transmittance import FORMULA

LAYERS_NAME = "layers.json"
FORMAT_NAME = "mbtf-layers"
SCHEMA_VERSION = 2


def _numbers(array: Any, half: bool) -> Any:
    """Nested lists of decimals that single precision reads as exactly these numbers."""
    stored = np.asarray(array, np.float32)
    if stored.ndim == 0:
        # 16-bit floats have few enough digits to be written out.
        return float(stored) if half else float(str(stored[()]))
    return [_numbers(row, half) for row in stored]


def _layer(name: str, weight: Tensor, bias: Tensor, activation: str, half: bool) -> dict[str, Any]:
    size = {"size": weight.shape[2]} if weight.ndim == 4 else {}
    return {
        "name": name,
        "type": "convolution" if weight.ndim == 4 else "dense",
        "inputs": weight.shape[1],
        "outputs": weight.shape[0],
        **size,
        "activation": activation,
        "weight": _numbers(weight.cpu(), half),
        "bias": _numbers(bias.cpu(), half),
    }


def layers(material: Material, *, half: bool = False) -> dict[str, list[dict[str, Any]]]:
    """Network → its layers in order, each with name, shape, activation, weight and bias."""
    weights = material.model.weights()
    out: dict[str, list[dict[str, Any]]] = {}
    names = [name.removesuffix(".weight") for name in weights if name.endswith(".weight")]
    for network in ("offset_network", "decoder"):
        mine = [name for name in names if name.startswith(f"{network}.")]
        for name in mine:
            activation = "none" if name == mine[-1] else material.config.network.activation
            layer = _layer(name, weights[f"{name}.weight"], weights[f"{name}.bias"], activation, half)
            out.setdefault(network, []).append(layer)
    return out


def _expected_transmittance(material: Material) -> dict[str, Any]:
    """Transmittance of the conformance queries; empty for an opaque material."""
    if material.transmittance is None:
        return {}
    queries = (material.conformance[name] for name in ("u", "sigma", "omega_o"))
    return {"transmittance": _numbers(material.transmittance.evaluate(*queries), False)}


def write_layers(material: Material, path: Path, *, half: bool = False) -> None:
    """Write everything but the textures: layers, formulas and conventions as text, shapes, and the
    conformance queries with their expected values. The transmittance follows in the same form.

    Parameters
    ----------
    half : numbers are 16-bit floats; the material is one of :func:`~mbtf_fit.material.export.half.to_half`

    Raises
    ------
    PartialError : the disk is full or the folder cannot be written
    """
    parts = {
        name: {"shape": list(t.shape), "channels": channel_names(name, t.shape[2])}
        for name, t in texture_parts(material).items()
    }
    lattice = material.lattice
    calibration = material.model.weights().get("calibration")
    document = {
        "format": FORMAT_NAME,
        "schema": SCHEMA_VERSION,
        "model": material.model.name,
        "precision": "float16" if half else "float32",
        "formula": material.model.formula(),
        "conventions": CONVENTIONS | MATERIAL_CONVENTIONS,
        "tile": {"aspect": lattice.aspect},
        "levels": {
            "finest": lattice.finest,
            "shapes": [list(lattice.shape(s)) for s in range(lattice.finest + 1)],
        },
        "unit": _numbers(material.model.unit.cpu(), False),
        "textures": {"file": TEXTURES_NAME, "parts": parts},
        "networks": layers(material, half=half),
        **({} if calibration is None else {"calibration": _numbers(calibration.cpu(), half)}),
        **({} if material.transmittance is None else {"transmittance": FORMULA}),
        "conformance": {
            **{name: _numbers(array, False) for name, array in material.conformance.items()},
            **_expected_transmittance(material),
            "tolerance": material.description["conformance"]["tolerance"],
        },
    }
    write_text(path, json.dumps(document, indent=1))

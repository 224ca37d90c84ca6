"""Latent textures as one EXR file: a part per level, a channel per feature.

The coefficients of the transmittance follow, a part per level and a channel per coefficient.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.atomic import write_through
from mbtf_fit.material.material import Material

TEXTURES_NAME = "textures.exr"
# Name of the parts of the transmittance, before the level.
TRANSMITTANCE_PART = "transmittance."


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
    """Write all textures, losslessly compressed; row 0 is the top, the side ``v → 1``.

    All parts share one display window, that of the finest level, as the format asks.

    Parameters
    ----------
    half : store 16-bit floats; the material is one of :func:`~mbtf_fit.material.export.half.to_half`

    Raises
    ------
    PartialError : the disk is full or the folder cannot be written
    """
    import OpenEXR

    rows, columns = material.lattice.shape()
    kind = np.float16 if half else np.float32
    parts = []
    for name, texture in texture_parts(material).items():
        channels = {
            channel: np.ascontiguousarray(texture[..., k], kind)
            for k, channel in enumerate(channel_names(name, texture.shape[2]))
        }
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "displayWindow": ((0, 0), (columns - 1, rows - 1)),
            "mbtf.model": material.model.name,
        }
        parts.append(OpenEXR.Part(header, channels, name=name))
    write_through(path, lambda temporary: OpenEXR.File(parts).write(str(temporary)))

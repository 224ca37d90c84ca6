"""All numbers that a shader reads, in one buffer of vectors of four: textures, nodes of the height field, and
weights.

A texture has its levels one below the other, coarsest first, and layers of four channels each. Texel (x, y)
of a layer is vector ``first + (layer · height + y) · width + x``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mbtf_core.height_planes import node_table
from mbtf_fit.material.material import Material
from mbtf_fit.ops.constants import AZIMUTHS, HEIGHTS, HORIZONS, MAPS
from mbtf_fit.viewer.shader import NODE_SHIFT

F32 = NDArray[np.float32]


@dataclass
class TexelBuffer:
    """The buffer while it is filled.

    Attributes
    ----------
    images : name → (first vector, width, height)
    """

    images: dict[str, tuple[int, int, int]] = field(default_factory=dict)
    _parts: list[F32] = field(default_factory=list)
    _count: int = 0

    def add(self, name: str, vectors: F32, width: int, height: int) -> None:
        """Append vectors (n, 4)."""
        self.images[name] = (self._count, width, height)
        self._parts.append(np.ascontiguousarray(vectors, np.float32))
        self._count += len(vectors)

    def add_levels(self, name: str, levels: Sequence[F32]) -> None:
        """Append a texture of levels (rows, columns, channels)."""
        width, height = max(t.shape[1] for t in levels), sum(t.shape[0] for t in levels)
        layers = -(-levels[0].shape[2] // 4)
        out, start = np.zeros((layers, height, width, 4), np.float32), 0
        for texels in levels:
            rows, columns, channels = texels.shape
            padded = np.zeros((rows, columns, 4 * layers), np.float32)
            padded[..., :channels] = texels
            out[:, start : start + rows, :columns] = padded.reshape(rows, columns, layers, 4).transpose(
                2, 0, 1, 3
            )
            start += rows
        self.add(name, out.reshape(-1, 4), width, height)

    def array(self) -> F32:
        """All vectors (n, 4)."""
        return np.concatenate(self._parts)


def texels_of(material: Material, weights: F32) -> TexelBuffer:
    """The buffer of a material.

    Parameters
    ----------
    material : Material
    weights : (n, 4) array
        Of the networks (:class:`~mbtf_fit.viewer.shader.Weights`).
    """
    tensors = {name: t.cpu().float().numpy() for name, t in material.model.weights().items()}

    def levels(name: str) -> list[F32]:
        count = sum(key.startswith(f"{name}.") for key in tensors)
        return [tensors[f"{name}.{s}"] for s in range(count)]

    out = TexelBuffer()
    out.add_levels("pyramid_texture", levels("pyramid"))
    if "offset_texture.0" in tensors:
        out.add_levels("offset_texture", levels("offset_texture"))
    if HEIGHTS in tensors:
        out.add_levels("map_texture", levels(MAPS))
        out.add_levels("horizon_texture", [_pairs(texels) for texels in levels(HORIZONS)])
        nodes = node_table(tensors[HEIGHTS][::-1, :, 0].astype(np.float64))
        width = 1 << NODE_SHIFT
        out.add("node_texture", nodes, width, -(-len(nodes) // width))
    if material.transmittance is not None:
        out.add_levels("transmittance_texture", material.transmittance.levels)
    if "calibration" in tensors:
        tables = tensors["calibration"]
        padded = np.concatenate([tables, np.zeros((*tables.shape[:3], 1), np.float32)], -1)
        out.add(
            "calibration_texture", padded.reshape(-1, 4), tables.shape[2], tables.shape[0] * tables.shape[1]
        )
    out.add("weights", weights, len(weights), 1)
    return out


def _pairs(texels: F32) -> F32:
    """Mean and second moment of the horizon at each azimuth and at the next: four channels per azimuth."""
    mean, square = texels[..., :AZIMUTHS], texels[..., AZIMUTHS:]
    both = np.stack([mean, square, np.roll(mean, -1, -1), np.roll(square, -1, -1)], -1)
    return both.reshape(*texels.shape[:2], 4 * AZIMUTHS)

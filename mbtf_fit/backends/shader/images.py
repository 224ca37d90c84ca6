"""The numbers that a shader reads, in vectors of four: images, and weights of networks.

An image has its levels one below the other, coarsest first, and layers of four channels each. A table has
one layer. In one buffer of all numbers, texel (x, y) of a layer is vector ``first + (layer · height + y) ·
width + x``. In a buffer of half precision, each vector has 8 bytes; those of tables have 16 there too, as
nodes of height fields are bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.height_planes import node_table
from mbtf_fit.ops.shade import adjacent_azimuths

F16 = NDArray[np.float16]
F32 = NDArray[np.float32]
# What the texels of an image are: channels as they are stored; filtered maps; horizons, of which neighbors
# lie side by side; nodes of a height field; rows of three numbers. The last two are tables.
Layout = Literal["plain", "maps", "horizons", "nodes", "rows"]
# Nodes per row of their table, as a power of two, as in heights.slang.
NODE_SHIFT = 11


@dataclass(frozen=True)
class TexelImage:
    """An image of a material's tensors.

    Attributes
    ----------
    name : in the shader
    source : name of the texture or tensor
    layout : what the texels are
    levels : (rows, columns, channels) arrays, coarsest first
    half : whether half precision suffices
    """

    name: str
    source: str
    layout: Layout
    levels: tuple[F32, ...]
    half: bool

    def __str__(self) -> str:
        return self.name

    @property
    def is_table(self) -> bool:
        """Whether it has one layer."""
        return self.layout in ("nodes", "rows")

    @property
    def layers(self) -> int:
        """Number of layers."""
        return -(-self.levels[0].shape[2] // (2 if self.layout == "horizons" else 4))

    def level(self, index: int) -> str:
        """Columns, rows and first row of a level, for the shader."""
        rows, columns = self.levels[index].shape[:2]
        return f"int3({columns}, {rows}, {sum(len(t) for t in self.levels[:index])})"

    def texels(self) -> F32:
        """(layers, height, width, 4)"""
        if self.layout == "nodes":
            nodes = node_table(self.levels[0][::-1, :, 0].astype(np.float64))
            width = 1 << NODE_SHIFT
            out = np.zeros((-(-len(nodes) // width) * width, 4), np.float32)
            out[: len(nodes)] = nodes
            return out.reshape(1, -1, width, 4)
        levels = [adjacent_azimuths(t) for t in self.levels] if self.layout == "horizons" else self.levels
        levels = [t.reshape(-1, *t.shape[-2:]) for t in levels]
        width, height = max(t.shape[1] for t in levels), sum(t.shape[0] for t in levels)
        layers = -(-levels[0].shape[2] // 4)
        stacked, start = np.zeros((height, width, 4 * layers), np.float32), 0
        for texels in levels:
            rows, columns, channels = texels.shape
            stacked[start : start + rows, :columns, :channels] = texels
            start += rows
        return np.ascontiguousarray(np.moveaxis(stacked.reshape(height, width, layers, 4), 2, 0))


def layer_vectors(weight: F32, bias: F32) -> F32:
    """Weights of a layer as vectors (n, 4): for each four outputs their biases, then, for each four inputs,
    the columns of a 4 × 4 matrix."""
    outputs, inputs = (-(-n // 4) for n in weight.shape)
    padded = np.zeros((4 * outputs, 1 + 4 * inputs), np.float32)
    padded[: len(bias), 0] = bias
    padded[: weight.shape[0], 1 : 1 + weight.shape[1]] = weight
    return padded.reshape(outputs, 4, -1).transpose(0, 2, 1).reshape(-1, 4)


def _halves(numbers: F32) -> F16:
    most = np.finfo(np.float16).max
    return numbers.clip(-most, most).astype("<f2")


def half_rows(matrix: F32) -> F16:
    """A matrix as cooperative vectors read it: rows begin at multiples of 16 bytes, matrices at multiples of
    128 in HLSL, of 64 in Vulkan."""
    rows, columns = matrix.shape
    padded = np.zeros((rows + -rows % 8, columns + -columns % 8), np.float32)
    padded[:rows, :columns] = matrix
    return _halves(padded)


@dataclass(frozen=True)
class Buffer:
    """All numbers of a shader.

    Attributes
    ----------
    content : vectors of four numbers, then matrices of cooperative vectors
    places : place (first, width, height) of each image
    weights : first vector of the networks
    matrices : first byte of the matrices
    """

    content: bytes
    places: list[str]
    weights: int
    matrices: int


def buffer_of(images: Sequence[TexelImage], weights: F32, matrices: Sequence[F16], *, half: bool) -> Buffer:
    """The buffer of a shader; whether its vectors are in half precision."""
    places, content, size = [], bytearray(), 8 if half else 16

    def append(numbers: F32, precise: bool) -> None:
        content.extend((numbers.astype("<f4") if precise else _halves(numbers)).tobytes())

    for image in images:
        texels = image.texels()
        _, height, width, _ = texels.shape
        places.append(f"{len(content) // size}, {width}, {height}")
        append(texels, not half or image.is_table)
    first = len(content) // size
    append(weights, not half)
    content.extend(bytes(-len(content) % 128))
    start = len(content)
    for matrix in matrices:
        content.extend(matrix.tobytes())
    return Buffer(bytes(content), places, first, start)

"""Textures as sums over their levels: a level holds what it adds to the next coarser one (Burt and Adelson,
"The Laplacian pyramid as a compact image code", 1983).

The few texels of coarse levels then learn from the queries of all finer footprints, and a texel of a fine
level learns from noisy queries only in what it differs from its neighborhood.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_fit.surface.lookup import Packing


@dataclass(frozen=True)
class Taps:
    """Numbers along an axis as weighted sums of others.

    Attributes
    ----------
    index : (size, taps) int32 numbers that are summed
    weight : (size, taps) float32
    """

    index: NDArray[np.int32]
    weight: NDArray[np.float32]

    def transposed(self, size: int) -> Taps:
        """The transposed sums, over `size` numbers."""
        dense = np.zeros((size, len(self.index)), np.float32)
        np.add.at(dense, (self.index, np.arange(len(self.index))[:, None]), self.weight)
        most = int((dense != 0).sum(1).max())
        index = np.argsort(dense == 0, axis=1, kind="stable")[:, :most]
        weight = np.take_along_axis(dense, index, 1)
        return Taps(np.ascontiguousarray(index, np.int32), np.ascontiguousarray(weight))


@cache
def interpolation(size: int, coarser: int) -> Taps:
    """Linear interpolation of a period of `coarser` texels at the centers of `size` texels."""
    x = (np.arange(size) + 0.5) * coarser / size - 0.5
    left = np.floor(x)
    right = (x - left).astype(np.float32)
    index = np.stack([left % coarser, (left + 1) % coarser], -1)
    return Taps(index.astype(np.int32), np.stack([1 - right, right], -1))


@cache
def _on(device: torch.device, size: int, coarser: int) -> tuple[Tensor, Tensor, Tensor]:
    """The two texels of each interpolation, and the weight of the second one."""
    taps = interpolation(size, coarser)
    left, right = (torch.from_numpy(taps.index[:, k].copy()).to(device) for k in (0, 1))
    return left, right, torch.from_numpy(taps.weight[:, 1].copy()).to(device)


def enlarged(texture: Tensor, shape: tuple[int, int]) -> Tensor:
    """A periodic texture (rows, columns, channels) at another resolution, interpolated; differentiable."""
    for axis, size in enumerate(shape):
        left, right, weight = _on(texture.device, size, texture.shape[axis])
        start, end = (texture.index_select(axis, index) for index in (left, right))
        texture = torch.lerp(start, end, weight.to(texture.dtype).view(-1, *[1] * (2 - axis)))
    return texture


def summed(residuals: Tensor, packing: Packing) -> Tensor:
    """Texels (texels, channels) of all levels from what each adds to the next coarser one; differentiable."""
    out: list[Tensor] = []
    for level, shape in zip(packing.split(residuals), packing.shapes, strict=True):
        out.append(level + enlarged(out[-1], shape) if out else level)
    return packing.join(out)


def residuals_of(texels: Tensor, packing: Packing) -> Tensor:
    """Inverse of :func:`summed`."""
    levels = packing.split(texels)
    finer = [
        level - enlarged(coarser, shape)
        for coarser, level, shape in zip(levels, levels[1:], packing.shapes[1:], strict=False)
    ]
    return packing.join([levels[0], *finer])

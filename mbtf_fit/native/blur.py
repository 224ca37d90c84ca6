"""Blur of packed textures by the kernel, equal to :func:`mbtf_fit.models.blur.blur_texture`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_fit.models.blur import NEGLIGIBLE, gaussian_taps
from mbtf_fit.models.textures import FeatureTextures
from mbtf_fit.native.library import Kernel

if TYPE_CHECKING:
    from mbtf_fit.objective.parallel import Workers

# Textures of fewer texels are blurred by one thread.
_SMALL = 1 << 12


class Blur:
    """Blurs one packed set of textures by the same width in tile widths at every level.

    Parameters
    ----------
    texture : whose tables are blurred
    sigma : texels of the finest level
    """

    def __init__(self, kernel: Kernel, texture: FeatureTextures, sigma: float) -> None:
        self.kernel = kernel
        self.packing = texture.packing
        self.channels = texture.texels.shape[1]
        finest = self.packing.shapes[-1][1]
        self._taps: list[tuple[NDArray[np.float32], NDArray[np.float32]] | None] = []
        for rows, columns in self.packing.shapes:
            local = sigma * columns / finest
            if local < NEGLIGIBLE:
                self._taps.append(None)
            else:
                across = _taps(local, columns)
                self._taps.append((across if rows == columns else _taps(local, rows), across))

    @property
    def idle(self) -> bool:
        """Whether it changes nothing."""
        return all(taps is None for taps in self._taps)

    def apply(self, table: Tensor, between: Tensor, out: Tensor, workers: Workers) -> None:
        """out = blurred table; `between` is scratch. All (texels, channels), contiguous float32, apart."""
        workers.each(lambda part: self._pass(0, table, between, part, workers.count))
        workers.each(lambda part: self._pass(1, between, out, part, workers.count))

    def _pass(self, axis: int, source: Tensor, target: Tensor, part: int, parts: int) -> None:
        starts = self.packing.starts
        for s, (rows, columns) in enumerate(self.packing.shapes):
            if rows * columns < _SMALL:
                first, last = (0, rows) if part == 0 else (0, 0)
            else:
                first, last = rows * part // parts, rows * (part + 1) // parts
            if first == last:
                continue
            taps = self._taps[s]
            if taps is None:
                cells = slice(starts[s] + first * columns, starts[s] + last * columns)
                target[cells] = source[cells]
                continue
            offset = 4 * starts[s] * self.channels
            filtered = taps[axis]
            number = len(filtered)
            addresses = np.empty(number, np.uintp)
            library, variant = self.kernel.library, self.kernel.variant
            here, there = source.data_ptr() + offset, target.data_ptr() + offset
            weights = filtered.ctypes.data
            if axis == 0:
                width = columns * self.channels
                library.mbtf_blur_down(
                    variant, here, rows, width, weights, number, first, last, addresses.ctypes.data, there
                )
            else:
                wide = np.empty((columns + number) * self.channels, np.float32)
                library.mbtf_blur_across(
                    *(variant, here, columns, self.channels, weights, number, first, last),
                    *(addresses.ctypes.data, wide.ctypes.data, there),
                )


def _taps(sigma: float, size: int) -> NDArray[np.float32]:
    if size == 1:
        return np.ones(1, np.float32)
    return np.ascontiguousarray(gaussian_taps(sigma, size).numpy(), np.float32)


def blur_table(kernel: Kernel, texture: FeatureTextures, sigma: float, workers: Workers) -> Tensor:
    """The texels of a texture, blurred by a Gaussian of `sigma` texels of the finest level, as a new
    table."""
    blur = Blur(kernel, texture, sigma)
    texels = texture.texels.detach()
    if blur.idle:
        return texels
    out = torch.empty_like(texels)
    blur.apply(texels, torch.empty_like(texels), out, workers)
    return out


__all__ = ["Blur", "blur_table"]

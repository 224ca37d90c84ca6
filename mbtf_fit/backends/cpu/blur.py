"""Blur of packed textures by the kernel, equal to :func:`mbtf_fit.pytorch.textures.blur_texture`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mbtf_fit.backends.cpu.model import share
from mbtf_fit.native.library import Kernel
from mbtf_fit.pytorch.textures import NEGLIGIBLE, FeatureTextures, gaussian_taps

if TYPE_CHECKING:
    from mbtf_fit.objective.parallel import Workers

# Textures of fewer texels are blurred by one thread.
_SMALL = 1 << 12


class Blur:
    """Blurs one packed set of textures by a Gaussian of `sigma` texels of the finest level, the same width in
    tile widths at every level."""

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
            first, last = share(rows, part, parts, whole=rows * columns < _SMALL)
            if first == last:
                continue
            taps = self._taps[s]
            if taps is None:
                cells = slice(starts[s] + first * columns, starts[s] + last * columns)
                target[cells] = source[cells]
                continue
            offset = 4 * starts[s] * self.channels
            here, there = source.data_ptr() + offset, target.data_ptr() + offset
            number = len(taps[axis])
            addresses = np.empty(number, np.uintp)
            work = (taps[axis].ctypes.data, number, first, last, addresses.ctypes.data)
            library, variant = self.kernel.library, self.kernel.variant
            if axis == 0:
                library.mbtf_blur_down(variant, here, rows, columns * self.channels, *work, there)
            else:
                wide = np.empty((columns + number) * self.channels, np.float32)
                size = (columns, self.channels)
                library.mbtf_blur_across(variant, here, *size, *work, wide.ctypes.data, there)


def _taps(sigma: float, size: int) -> NDArray[np.float32]:
    if size == 1:
        return np.ones(1, np.float32)
    return np.ascontiguousarray(gaussian_taps(sigma, size).numpy(), np.float32)

"""One step of training by the kernel, with the blur of its textures. Adam's state is laid out as that of
PyTorch's own optimizer, so that both are interchangeable. The blur is that of
:func:`mbtf_fit.pytorch.textures.blur_texture`."""

from __future__ import annotations

import ctypes
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_fit.backends.cpu.gradients import NativeGradients
from mbtf_fit.backends.cpu.model import NativeModel, share
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.native.library import AdamStep, Kernel
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.parallel import Workers
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.pytorch.residuals import Taps, interpolation
from mbtf_fit.pytorch.textures import NEGLIGIBLE, FeatureTextures, gaussian_taps

# Parameters with fewer numbers are updated by one thread.
_SMALL_PARAMETER = 1 << 14
# Textures of fewer texels are blurred by one thread.
_SMALL_TEXTURE = 1 << 12


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
            first, last = share(rows, part, parts, whole=rows * columns < _SMALL_TEXTURE)
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


class Sums:
    """Sums the levels of one packed set of textures, each of which adds to the next coarser one, as
    :func:`mbtf_fit.pytorch.residuals.summed`."""

    def __init__(self, kernel: Kernel, texture: FeatureTextures) -> None:
        self.kernel = kernel
        self.packing = texture.packing
        self.channels = texture.texels.shape[1]
        shapes = self.packing.shapes
        self._up = [
            tuple(interpolation(a, b) for a, b in zip(fine, coarse, strict=True))
            for coarse, fine in pairwise(shapes)
        ]
        self._down = [
            tuple(taps.transposed(size) for taps, size in zip(up, coarse, strict=True))
            for up, coarse in zip(self._up, shapes, strict=False)
        ]

    def apply(self, table: Tensor, workers: Workers) -> None:
        """Sum the levels of a table (texels, channels) in place."""
        for s, taps in enumerate(self._up):
            self._add(table, s, s + 1, taps, workers)

    def apply_transposed(self, gradient: Tensor, workers: Workers) -> None:
        """The gradient (texels, channels) by the residuals from that by the texels, in place."""
        for s, taps in reversed(list(enumerate(self._down))):
            self._add(gradient, s + 1, s, taps, workers)

    def _add(self, table: Tensor, source: int, target: int, taps: tuple[Taps, ...], workers: Workers) -> None:
        """Add a resampled level to another one."""
        starts, (rows, columns) = self.packing.starts, self.packing.shapes[target]
        width = self.packing.shapes[source][1] * self.channels
        there, here = (table.data_ptr() + 4 * starts[s] * self.channels for s in (source, target))
        down, across = ((t.index.ctypes.data, t.weight.ctypes.data, t.index.shape[1]) for t in taps)

        def add_part(part: int) -> None:
            first, last = share(rows, part, workers.count, whole=rows * columns < _SMALL_TEXTURE)
            if first < last:
                wide = np.empty(width, np.float32)
                self.kernel.library.mbtf_resample(
                    *(self.kernel.variant, there, width, self.channels, columns, *down, *across),
                    *(first, last, wide.ctypes.data, here),
                )

        workers.each(add_part)


class Adam:
    """Groups of parameters with their options, and the moments of each parameter, as ``torch.optim.Adam`` has
    them. Making that one would import PyTorch's compiler, which takes a second.

    Parameters
    ----------
    groups : parameters of each group
    betas : decay rates of the moments
    """

    def __init__(self, groups: Sequence[Sequence[Tensor]], betas: tuple[float, float]) -> None:
        self.param_groups: list[dict[str, Any]] = [
            {"params": list(params), "lr": 0.0, "betas": betas, "eps": 1e-8} for params in groups
        ]
        self.state: defaultdict[Tensor, dict[str, Tensor]] = defaultdict(dict)


class NativeStepper:
    """Training steps of a material that the kernel supports."""

    def __init__(self, kernel: Kernel, model: NeuralMaterial, optimizer: Adam) -> None:
        self.kernel = kernel
        self.optimizer = optimizer
        self._native = NativeModel(kernel, model)
        self._gradients = NativeGradients(self._native)
        # Memory for the blur of each texture and of its gradient.
        self._tables, self._between, self._blurred = (
            [torch.empty_like(texture.texels) for texture in self._native.textures] for _ in range(3)
        )
        self._sums = [
            Sums(kernel, texture) if texture.residual else None for texture in self._native.textures
        ]

    def step(
        self, objective: Objective, batch: TrainingQueries, sigmas: Sequence[float], workers: Workers
    ) -> Tensor:
        """One step on a batch, textures blurred by `sigmas` texels of the finest level; its mean loss."""
        textures = self._native.textures
        blurs = [Blur(self.kernel, t, sigma) for t, sigma in zip(textures, sigmas, strict=True)]
        for texture, blur, sums, between, table in zip(
            textures, blurs, self._sums, self._between, self._tables, strict=True
        ):
            if blur.idle and sums is None:
                texture.read(texture.texels)
                continue
            # A copy where the blur is idle.
            blur.apply(texture.texels.detach(), between, table, workers)
            if sums is not None:
                sums.apply(table, workers)
            texture.read(table)
        loss = self._gradients.compute(objective, batch, workers)
        found: dict[Tensor, Tensor] = {}
        for k, (texture, blur, sums) in enumerate(zip(textures, blurs, self._sums, strict=True)):
            gradient = self._gradients.textures[k]
            if sums is not None:
                sums.apply_transposed(gradient, workers)
            if not blur.idle:
                # A symmetric kernel is its own transpose.
                blur.apply(gradient, self._between[k], self._blurred[k], workers)
                gradient = self._blurred[k]
            found[texture.texels] = gradient
        found.update(self._gradients.weights())
        adam(self.kernel, self.optimizer, found, workers)
        return loss


def adam(
    kernel: Kernel, optimizer: Adam | torch.optim.Adam, gradients: Mapping[Tensor, Tensor], workers: Workers
) -> None:
    """One step for the parameters that have a gradient (contiguous float32, same shape), as
    ``torch.optim.Adam.step()`` takes it, on the same state: without weight decay, with the groups' rates and
    decays."""
    tasks: list[tuple[AdamStep, Tensor, Tensor, Tensor, Tensor]] = []
    for group in optimizer.param_groups:
        beta1, beta2 = group["betas"]
        for parameter in group["params"]:
            gradient = gradients.get(parameter)
            if gradient is None:
                continue
            state = optimizer.state[parameter]
            if not state:
                zeros = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
                state.update(step=torch.zeros(()), **zeros)
            state["step"] += 1
            t = float(state["step"])
            step = AdamStep(
                float(group["lr"]) / (1 - beta1**t), beta1, beta2, group["eps"], math.sqrt(1 - beta2**t)
            )
            tasks.append((step, gradient, parameter, state["exp_avg"], state["exp_avg_sq"]))

    def step_part(part: int) -> None:
        for step, *tensors in tasks:
            n = tensors[0].numel()
            first, last = share(n, part, workers.count, whole=n < _SMALL_PARAMETER)
            if first < last:
                addresses = (tensor.data_ptr() + 4 * first for tensor in tensors)
                kernel.library.mbtf_adam(kernel.variant, ctypes.byref(step), last - first, *addresses)

    workers.each(step_part)

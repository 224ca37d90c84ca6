"""One step of training by the kernel. Adam works on the state of PyTorch's own optimizer, so that both are
interchangeable."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from mbtf_fit.backends.cpu.blur import Blur
from mbtf_fit.backends.cpu.gradients import NativeGradients
from mbtf_fit.backends.cpu.model import NativeModel, share
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.native.library import AdamStep, Kernel
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.parallel import Workers
from mbtf_fit.pytorch.material import NeuralMaterial

# Parameters with fewer numbers are updated by one thread.
_SMALL = 1 << 14


class NativeStepper:
    """Training steps of a material that the kernel supports."""

    def __init__(self, kernel: Kernel, model: NeuralMaterial, optimizer: torch.optim.Adam) -> None:
        self.kernel = kernel
        self.optimizer = optimizer
        self._native = NativeModel(kernel, model)
        self._gradients = NativeGradients(self._native)
        # Memory for the blur of each texture and of its gradient.
        self._tables, self._between, self._blurred = (
            [torch.empty_like(texture.texels) for texture in self._native.textures] for _ in range(3)
        )

    def step(
        self, objective: Objective, batch: TrainingQueries, sigmas: Sequence[float], workers: Workers
    ) -> Tensor:
        """One step on a batch, textures blurred by `sigmas` texels of the finest level; its mean loss."""
        textures = self._native.textures
        blurs = [Blur(self.kernel, t, sigma) for t, sigma in zip(textures, sigmas, strict=True)]
        for texture, blur, between, table in zip(textures, blurs, self._between, self._tables, strict=True):
            if blur.idle:
                texture.read(texture.texels)
            else:
                blur.apply(texture.texels.detach(), between, table, workers)
                texture.read(table)
        loss = self._gradients.compute(objective, batch, workers)
        found: dict[Tensor, Tensor] = {}
        for k, (texture, blur) in enumerate(zip(textures, blurs, strict=True)):
            gradient = self._gradients.textures[k]
            if not blur.idle:
                # A symmetric kernel is its own transpose.
                blur.apply(gradient, self._between[k], self._blurred[k], workers)
                gradient = self._blurred[k]
            found[texture.texels] = gradient
        found.update(self._gradients.weights())
        adam(self.kernel, self.optimizer, found, workers)
        return loss


def adam(
    kernel: Kernel, optimizer: torch.optim.Adam, gradients: Mapping[Tensor, Tensor], workers: Workers
) -> None:
    """One step for the parameters that have a gradient (contiguous float32, same shape), as
    ``optimizer.step()`` takes it, on the same state: without weight decay, with the groups' rates and
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
            first, last = share(n, part, workers.count, whole=n < _SMALL)
            if first < last:
                addresses = (tensor.data_ptr() + 4 * first for tensor in tensors)
                kernel.library.mbtf_adam(kernel.variant, ctypes.byref(step), last - first, *addresses)

    workers.each(step_part)

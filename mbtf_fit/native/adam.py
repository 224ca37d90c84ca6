"""Adam by the kernel, on the state of PyTorch's own optimizer, so that both are interchangeable."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mbtf_fit.native.library import AdamStep, Kernel

if TYPE_CHECKING:
    from mbtf_fit.objective.parallel import Workers

# Parameters with fewer numbers are updated by one thread.
_SMALL = 1 << 14


def adam(
    kernel: Kernel, optimizer: torch.optim.Adam, gradients: Mapping[Tensor, Tensor], workers: Workers
) -> None:
    """One step for the parameters that have a gradient (contiguous float32, same shape), as
    ``optimizer.step()`` takes it: without weight decay, with the groups' rates and decays.

    Parameters
    ----------
    gradients : parameter → its gradient
    """
    tasks: list[tuple[AdamStep, Tensor, Tensor, Tensor, Tensor]] = []
    for group in optimizer.param_groups:
        beta1, beta2 = group["betas"]
        for parameter in group["params"]:
            gradient = gradients.get(parameter)
            if gradient is None:
                continue
            state = optimizer.state[parameter]
            if not state:
                state["step"] = torch.zeros(())
                state["exp_avg"] = torch.zeros_like(parameter)
                state["exp_avg_sq"] = torch.zeros_like(parameter)
            state["step"] += 1
            t = float(state["step"])
            step = AdamStep(
                float(group["lr"]) / (1 - beta1**t), beta1, beta2, group["eps"], math.sqrt(1 - beta2**t)
            )
            tasks.append((step, gradient, parameter, state["exp_avg"], state["exp_avg_sq"]))

    def step_part(part: int) -> None:
        for step, *tensors in tasks:
            n = tensors[0].numel()
            first, last = n * part // workers.count, n * (part + 1) // workers.count
            if n < _SMALL:
                first, last = (0, n) if part == 0 else (0, 0)
            if first < last:
                kernel.library.mbtf_adam(
                    kernel.variant,
                    ctypes.byref(step),
                    last - first,
                    *(tensor.data_ptr() + 4 * first for tensor in tensors),
                )

    workers.each(step_part)

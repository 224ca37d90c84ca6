"""One step of training by the kernel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.models.interface import NeuralMaterial
from mbtf_fit.native.adam import adam
from mbtf_fit.native.blur import Blur
from mbtf_fit.native.gradients import NativeGradients
from mbtf_fit.native.library import Kernel
from mbtf_fit.native.model import NativeModel, networks
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.parallel import Workers


class NativeStepper:
    """Training steps of one model.

    Parameters
    ----------
    model : supported by the kernel
    optimizer : state and learning rates
    """

    def __init__(self, kernel: Kernel, model: NeuralMaterial, optimizer: torch.optim.Adam) -> None:
        self.kernel = kernel
        self.model = model
        self.optimizer = optimizer
        self._native = NativeModel(kernel, model)
        self._gradients = NativeGradients(self._native)
        texels = [texture.texels for texture in model.textures()]
        self._tables = [torch.empty_like(t) for t in texels]
        self._between = [torch.empty_like(t) for t in texels]
        self._blurred = [torch.empty_like(t) for t in texels]

    def step(
        self, objective: Objective, batch: TrainingQueries, sigmas: Sequence[float], workers: Workers
    ) -> Tensor:
        """One step on a batch, textures blurred by `sigmas` texels of the finest level; its mean loss."""
        textures = self.model.textures()
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
        for network, gradients in zip(networks(self.model), self._gradients.networks, strict=True):
            found.update(zip(network.parameters(), gradients, strict=True))
        adam(self.kernel, self.optimizer, found, workers)
        return loss

"""The training loop: batches, loss, and optimizer steps."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import NoReturn

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_fit.backends.cpu.model import supports
from mbtf_fit.backends.cpu.stepper import NativeStepper
from mbtf_fit.config import FitConfig
from mbtf_fit.data.images import TrainingImages
from mbtf_fit.data.queries import ShardQueries, TrainingQueries
from mbtf_fit.data.slices import SharedSlices, TrainingSlices
from mbtf_fit.data.streaming import Selection, StreamedQueries
from mbtf_fit.material.inference import predict
from mbtf_fit.models.model import Model
from mbtf_fit.models.registry import MODELS
from mbtf_fit.native import kernel
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.objective.parallel import MAX_KERNEL_THREADS, MAX_THREADS, Batch, Workers
from mbtf_fit.objective.regularization import WeightDecay
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.sections import TrainingSection
from mbtf_fit.textures.blur import annealed_sigma
from mbtf_fit.training.calibration import fit_calibration
from mbtf_fit.training.loop import TrainingLoop, TrainingProgress, health_of

TrainingData = TrainingQueries | TrainingImages | TrainingSlices | SharedSlices | StreamedQueries
# Decay rates of Adam's moments.
BETAS = (0.8, 0.95)
# Widest blur, in tile widths. A blur of half a tile made training unstable on textures of 16 × 16 texels: the
# offsets of three of eight fits diverged before the textures became sharp.
WIDEST_BLUR = 0.125
# Difference of fractional levels that rounding explains.
_SAME_LEVEL = 1e-4


def learning_rate_factor(training: TrainingSection, step: int, fraction: float) -> float:
    """Factor of the learning rates after a fraction of the budget: linear warm-up, then cosine decay."""
    rise = min(1.0, (step + 1) / (training.warmup + 1))
    last = training.final_learning_rate_factor
    fall = last + (1 - last) * 0.5 * (1 + math.cos(math.pi * min(fraction, 1.0)))
    return rise * fall


class Trainer(TrainingLoop):
    """Training of one model on one set of queries.

    Parameters
    ----------
    model : initialized, on the device
    queries : on the device
    noise : model of their noise
    selection : rows of the shards that the queries are, to name a bad batch
    hooks : the model of the material, prepared; by default that of the configuration
    """

    def __init__(
        self,
        config: FitConfig,
        model: NeuralMaterial,
        queries: TrainingData,
        noise: NoiseModel,
        selection: Selection | None = None,
        hooks: Model | None = None,
    ) -> None:
        self.config = config
        self.model = model
        self.hooks = MODELS[config.model](model) if hooks is None else hooks
        if isinstance(queries, TrainingImages):
            queries = replace(queries, patch_size=config.training.patch_size)
        self.queries: TrainingData = self.hooks.precompute(queries, config.data.memory)
        self.selection = selection
        self.device = next(model.parameters()).device
        self.progress = TrainingProgress()
        self.batch = min(config.training.batch, len(queries))
        texels, weights = self.hooks.trained()
        self.optimizer = torch.optim.Adam([{"params": texels}, {"params": weights}], betas=BETAS, fused=True)
        self.loss = Objective(config.training, noise)
        self.weight_decay = WeightDecay.of(config.training, noise.ratio, len(queries))
        found = kernel()
        self._stepper = (
            NativeStepper(found, model, self.optimizer) if found is not None and supports(model) else None
        )

    @property
    def backend(self) -> str:
        """``kernel`` and its instruction set, or ``pytorch``."""
        return "pytorch" if self._stepper is None else f"kernel {self._stepper.kernel.name}"

    @property
    def max_threads(self) -> int:
        return MAX_THREADS if self._stepper is None else MAX_KERNEL_THREADS

    def _batches(self, first: int | None = None) -> Iterator[Batch]:
        """Endless batches, from that of a number or of the current step on."""
        first = self.progress.step if first is None else first
        return self.queries.batches(self.batch, self.config.seed, first, self.model.margin)

    def steps(self, workers: Workers, first: int) -> Iterator[Tensor]:
        """Endless steps from the batch of a number on; each yields its mean loss."""
        for batch in self._batches(first):
            yield self._step(batch, workers)

    def _steps(self, workers: Workers) -> Iterator[Tensor]:
        return self.steps(workers, self.progress.step)

    def _parameters(self) -> Iterator[Tensor]:
        yield from self.model.parameters()
        yield from self.hooks.parameters().values()

    def health(self) -> Tensor:
        """A number that is finite if all network weights are."""
        return health_of(self.hooks.trained()[1], self.device)

    def _stop_at(self, step: int) -> NoReturn:
        self.stop_at(step, step)

    def stop_at(self, step: int, batch: int) -> NoReturn:
        """Report that training diverged at a step of the loop, which read the batch of this number."""
        ranges = self.queries.batch_ranges(self.batch, self.config.seed, batch)
        named = f", {self.selection.describe(ranges)}," if self.selection is not None else ""
        raise InputError(
            f"training diverged at step {step + 1}: its batch{named} gave numbers that are not finite",
            hint="lower the learning rate: --learning-rate "
            f"{self.config.training.learning_rate / 3:.1g} --overwrite",
        ) from None

    def _sigmas(self) -> list[float]:
        """Current blur of each texture, in texels of the finest level."""
        blur, model = self.config.training.blur, self.model
        start = min(blur.initial_sigma, max(WIDEST_BLUR * min(model.lattice.shape()), blur.final_sigma))
        sigma = annealed_sigma(self.fraction / blur.fraction, start, blur.final_sigma)
        return [
            max(sigma, blur.offset_sigma if t.moves_lookups else blur.min_sigma) for t in model.textures()
        ]

    def _tables(self) -> list[Tensor]:
        """The textures with the current blur."""
        return [t.blurred(sigma) for t, sigma in zip(self.model.textures(), self._sigmas(), strict=True)]

    def _loss(self, batch: Batch) -> Tensor:
        return self.loss(*self.hooks.predict(batch))

    def _step(self, batch: Batch, workers: Workers) -> Tensor:
        training = self.config.training
        factor = learning_rate_factor(training, self.progress.step, self.fraction)
        rates = (training.texture_learning_rate * factor, training.learning_rate * factor)
        for group, rate in zip(self.optimizer.param_groups, rates, strict=True):
            group["lr"] = rate
        self.weight_decay.apply(self.model, *rates)
        sigmas = self._sigmas()
        named = {
            name: sigma
            for name, module in self.model.named_children()
            for texture, sigma in zip(self.model.textures(), sigmas, strict=True)
            if module is texture
        }
        batch = self.hooks.before_step(self.progress.step, self.fraction, named, batch)
        self.loss.fraction = self.fraction
        if self._stepper is not None:
            assert isinstance(batch, TrainingQueries)
            return self._stepper.step(self.loss, batch, sigmas, workers)
        texels, weights = self.hooks.trained()
        # Lookups read detached tables; their gradients pass through the blur once, for the whole batch.
        tables = self._tables() if texels else []
        leaves = [t.detach().requires_grad_() for t in tables]
        for texture, leaf in zip(self.model.textures() if texels else [], leaves, strict=True):
            texture.read(leaf)
        loss, gradients = workers.gradients(self._loss, batch, [*leaves, *weights])
        by_table, by_weight = gradients[: len(leaves)], gradients[len(leaves) :]
        if texels:
            for p, g in zip(texels, torch.autograd.grad(tables, texels, by_table), strict=True):
                p.grad = g
        for p, g in zip(weights, by_weight, strict=True):
            # Gradients of convolutions have the channels last in memory, which PyTorch's fused Adam does not
            # support on CPUs: it would mix up the weights.
            p.grad = g.contiguous()
        self.optimizer.step()
        return loss

    def predict(self, queries: ShardQueries) -> NDArray[np.float32]:
        """Values (n, 3) of the current model with the current blur."""
        self._read_blurred()
        return predict(self.model, queries.u, queries.sigma, queries.omega_i, queries.omega_o)

    def _read_blurred(self) -> None:
        """Let lookups read the textures with the current blur, or those that the encoder writes."""
        if self.hooks.write_textures(self.queries):
            return
        with torch.no_grad():
            for texture, table in zip(self.model.textures(), self._tables(), strict=True):
                texture.read(table)

    def calibrate(self) -> None:
        """Fit the calibration factors (:mod:`~mbtf_fit.training.calibration`), if the configuration asks for
        them and the model has some."""
        model = self.model
        if not (self.config.training.energy_calibration and self.hooks.calibrates):
            return
        assert isinstance(self.queries, TrainingQueries | StreamedQueries)
        self._read_blurred()
        model.calibrate(None)
        found = fit_calibration(
            partial(predict, model), model.lattice, self.queries, self.config.held_out, self.loss.bound
        )
        model.calibrate(torch.from_numpy(found).to(self.device))

    def fill_levels(self, coarsest: float) -> None:
        """Give levels of the pyramid below the fractional level of the data's largest footprint the averages
        of the next finer one. Measured BTFs have one footprint: their coarser levels would keep their initial
        noise."""
        self.model.textures()[0].average_coarser(math.floor(coarsest + _SAME_LEVEL))

    def coverage(self) -> dict[int, float]:
        """Level → fraction of the pyramid's texels that have received gradients."""
        pyramid = self.model.textures()[0]
        if not self.hooks.trained()[0]:
            return dict.fromkeys(range(self.model.lattice.finest + 1), 1.0)
        moment = self.optimizer.state.get(pyramid.texels, {}).get("exp_avg_sq")
        return {
            s: 0.0 if moment is None else float((moment[a:b] > 0).any(1).float().mean())
            for s, (a, b) in enumerate(pairwise(pyramid.packing.starts))
        }

"""The training loop: batches, loss, schedules, and a state that can be saved and taken up again."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import pairwise
from typing import Any, NoReturn

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_fit.config import FitConfig, TrainingSection
from mbtf_fit.data.images import Crops, TrainingBuffers
from mbtf_fit.data.loader import Queries, TrainingQueries
from mbtf_fit.data.streaming import Selection, StreamedQueries
from mbtf_fit.material.inference import predict
from mbtf_fit.models import Neumip, NeuralMaterial
from mbtf_fit.models.blur import annealed_sigma
from mbtf_fit.native import kernel
from mbtf_fit.native.model import unsupported_reason
from mbtf_fit.native.stepper import NativeStepper
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.objective.parallel import MAX_KERNEL_THREADS, Batch, Workers
from mbtf_fit.objective.regularization import Pull
from mbtf_fit.training.calibration import fit_gains

# Decay of Adam's running means of the gradient and of its square.
BETAS = (0.8, 0.95)
# Blur at its widest, in tile widths. Half a tile of blur left so little to find in textures of 16 x 16 texels
# that offsets wandered off before they became sharp: three of eight fits ended no better than without.
WIDEST_BLUR = 0.125


def rate_factor(training: TrainingSection, step: int, share: float) -> float:
    """What the rates are multiplied by when `share` of the budget is spent: a linear rise, then half a cosine
    down."""
    rise = min(1.0, (step + 1) / (training.warmup + 1))
    fall = training.final_rate + (1 - training.final_rate) * 0.5 * (1 + math.cos(math.pi * min(share, 1.0)))
    return rise * fall


@dataclass
class Progress:
    """How far training is.

    Attributes
    ----------
    step : steps done
    seconds : time spent in steps, over all runs
    loss : mean training loss of the last steps
    """

    step: int = 0
    seconds: float = 0.0
    loss: float = math.nan


class Trainer:
    """Trains one model on one set of queries.

    Parameters
    ----------
    model : initialized, on the device
    queries : on the device
    noise : model of their noise; :meth:`NoiseModel.silent` where there is none
    selection : which rows of which shards the queries are, to name a bad batch by

    Attributes
    ----------
    progress : how far it is
    pull : towards 0, of texels and weights
    stop : set it to end :meth:`train` after the present step
    """

    def __init__(
        self,
        config: FitConfig,
        model: NeuralMaterial,
        queries: TrainingQueries | TrainingBuffers | StreamedQueries,
        noise: NoiseModel,
        selection: Selection | None = None,
    ) -> None:
        self.config = config
        self.model = model
        if isinstance(queries, TrainingBuffers):
            queries = replace(queries, side=config.training.crop)
        self.queries = queries
        self.selection = selection
        self.device = next(model.parameters()).device
        self.progress = Progress()
        self.stop = False
        self.batch = min(config.training.batch, len(queries))
        texels, weights = model.parameter_groups()
        self.optimizer = torch.optim.Adam([{"params": texels}, {"params": weights}], betas=BETAS, fused=True)
        self.loss = Objective(config.training, noise)
        self.pull = Pull.of(config.training, noise.ratio, len(queries))
        found = kernel()
        self._stepper = (
            NativeStepper(found, model, self.optimizer)
            if found is not None and unsupported_reason(model) is None
            else None
        )

    @property
    def path(self) -> str:
        """What computes the steps: ``kernel`` and its instruction set, or ``pytorch``."""
        return "pytorch" if self._stepper is None else f"kernel {self._stepper.kernel.name}"

    @property
    def share(self) -> float:
        """Share of the budget that is spent, in [0, 1]."""
        training = self.config.training
        if training.steps is not None:
            return min(1.0, self.progress.step / training.steps)
        return min(1.0, self.progress.seconds / training.time)

    def _batches(self) -> Iterator[Batch]:
        """Endless batches from the current step on."""
        return self.queries.batches(self.batch, self.config.seed, self.progress.step, self.model.margin)

    def train(self, seconds: float) -> bool:
        """Train for about so long, or until the budget is spent; returns whether it is.

        Raises
        ------
        InputError : the loss or a weight is no longer finite
        """
        until = time.perf_counter() + seconds
        first = self.progress.step
        losses: list[Tensor] = []
        health: list[Tensor] = []
        batches = self._batches()
        limit = None if self._stepper is None else MAX_KERNEL_THREADS
        with Workers(self.device, limit=limit) as workers:
            while self.share < 1.0 and not (self.stop and losses):
                start = time.perf_counter()
                if start >= until and losses:
                    break
                try:
                    losses.append(self._step(next(batches), workers))
                except (RuntimeError, IndexError):
                    # A lookup at NaN has no texel and fails before the loss could show it.
                    if all(bool(p.isfinite().all()) for p in self.model.parameters()):
                        raise
                    self._stop_diverged(first, losses, health)
                health.append(self._health())
                self.progress.step += 1
                self.progress.seconds += time.perf_counter() - start
        if losses:
            self.progress.loss = float(torch.stack(losses).mean())
            if not math.isfinite(self.progress.loss + float(torch.stack(health).sum())):
                self._stop_diverged(first, losses, health)
        return self.share >= 1.0

    def _health(self) -> Tensor:
        """A number that is finite when the networks' weights are."""
        with torch.no_grad():
            return torch.stack([p.sum() for p in self.model.parameter_groups()[1]]).sum()

    def _stop_diverged(self, first: int, losses: list[Tensor], health: list[Tensor]) -> NoReturn:
        """Name the first bad batch of the steps since `first`.

        Raises
        ------
        InputError : always
        """
        good = 0
        for loss, weights in zip(losses, health, strict=False):
            if not math.isfinite(float(loss) + float(weights)):
                break
            good += 1
        step = first + good
        numbers = self.queries.numbers(self.batch, self.config.seed, step)
        named = f", {self.selection.describe(numbers)}," if self.selection is not None else ""
        raise InputError(
            f"training diverged at step {step + 1}: its batch{named} left numbers that are not finite",
            hint=f"lower the rate: --rate {self.config.training.rate / 3:.1g} --overwrite",
        ) from None

    def _sigmas(self) -> list[float]:
        """Blur of each texture at this moment, in texels of the finest level."""
        blur = self.config.training.blur
        start = min(blur.start, max(WIDEST_BLUR * min(self.model.lattice.shape()), blur.end))
        sigma = annealed_sigma(self.share / blur.share, start, blur.end)
        return [max(sigma, blur.offset if t.moves_lookups else blur.floor) for t in self.model.textures()]

    def _tables(self) -> list[Tensor]:
        """The textures through the blur of this moment."""
        return [t.blurred(sigma) for t, sigma in zip(self.model.textures(), self._sigmas(), strict=True)]

    def _loss(self, batch: Batch) -> Tensor:
        evaluate = self.model.crops if isinstance(batch, Crops) else self.model
        prediction = evaluate(batch.u, batch.sigma, batch.omega_i, batch.omega_o)
        return self.loss(prediction, batch)

    def _step(self, batch: Batch, workers: Workers) -> Tensor:
        training = self.config.training
        factor = rate_factor(training, self.progress.step, self.share)
        for group, rate in zip(
            self.optimizer.param_groups, (training.texture_rate, training.rate), strict=True
        ):
            group["lr"] = rate * factor
        self.pull.act(self.model, training.texture_rate * factor, training.rate * factor)
        if self._stepper is not None and not isinstance(batch, Crops):
            return self._stepper.step(self.loss, batch, self._sigmas(), workers)
        texels, weights = self.model.parameter_groups()
        # Queries read detached tables; what they give goes back through the blur once, for all of them.
        tables = self._tables()
        leaves = [t.detach().requires_grad_() for t in tables]
        for texture, leaf in zip(self.model.textures(), leaves, strict=True):
            texture.read(leaf)
        loss, gradients = workers.gradients(self._loss, batch, [*leaves, *weights])
        by_table, by_weight = gradients[: len(leaves)], gradients[len(leaves) :]
        for p, g in zip(texels, torch.autograd.grad(tables, texels, by_table), strict=True):
            p.grad = g
        for p, g in zip(weights, by_weight, strict=True):
            p.grad = g
        self.optimizer.step()
        return loss

    def predict(self, queries: Queries) -> NDArray[np.float32]:
        """Values (n, 3) of the model as it is now, read through the current blur."""
        self._settle()
        return predict(self.model, queries.u, queries.sigma, queries.omega_i, queries.omega_o)

    def _settle(self) -> None:
        """Let the textures be read through the current blur."""
        with torch.no_grad():
            for texture, table in zip(self.model.textures(), self._tables(), strict=True):
                texture.read(table)

    def calibrate(self) -> None:
        """Give the trained model the factors of :mod:`~mbtf_fit.training.calibration`, where it takes some and the
        configuration does not forbid it."""
        model = self.model
        if not (self.config.training.calibrate and isinstance(model, Neumip)):
            return
        assert not isinstance(self.queries, TrainingBuffers)
        self._settle()
        model.gain = None
        found = fit_gains(
            partial(predict, model), model.lattice, self.queries, self.config.held_out, self.loss.bound
        )
        model.gain = torch.from_numpy(found).to(self.device)

    def coverage(self) -> dict[int, float]:
        """Level → share of its texels that gradients have reached, of the pyramid."""
        pyramid = max(self.model.textures(), key=lambda t: len(t.packing.shapes))
        moment = self.optimizer.state.get(pyramid.texels, {}).get("exp_avg_sq")
        starts = pyramid.packing.starts
        return {
            s: 0.0 if moment is None else float((moment[a:b] > 0).any(1).float().mean())
            for s, (a, b) in enumerate(pairwise(starts))
        }

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """(tensors, plain data) that :meth:`restore` takes up again."""
        tensors = {f"model.{name}": p.detach() for name, p in self.model.named_parameters()}
        for name, p in self.model.named_parameters():
            for key, value in self.optimizer.state.get(p, {}).items():
                tensors[f"adam.{key}.{name}"] = value
        return tensors, {f.name: getattr(self.progress, f.name) for f in fields(Progress)}

    def restore(self, tensors: dict[str, Tensor], data: dict[str, Any]) -> None:
        """Take up a state of the same configuration and data: training goes on as if never interrupted.

        Raises
        ------
        KeyError, TypeError, ValueError, RuntimeError : the state is of another model, or damaged
        """
        with torch.no_grad():
            for name, p in self.model.named_parameters():
                p.copy_(tensors[f"model.{name}"])
                self.optimizer.state[p] = {
                    key: tensors[f"adam.{key}.{name}"].to(p.device)
                    for key in ("step", "exp_avg", "exp_avg_sq")
                    if f"adam.{key}.{name}" in tensors
                }
        self.progress = Progress(int(data["step"]), float(data["seconds"]), float(data["loss"]))

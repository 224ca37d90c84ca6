"""Training of one material: batches, loss, and optimizer steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.data.dataset import Dataset
from mbtf_fit.backends.cpu.model import supports
from mbtf_fit.backends.cpu.stepper import Adam, NativeStepper
from mbtf_fit.config import FitConfig
from mbtf_fit.data.layouts import SharedSlices, TrainingImages, TrainingSlices
from mbtf_fit.data.loader import Partition, load_training
from mbtf_fit.data.queries import ShardQueries, TrainingQueries, mean_value
from mbtf_fit.data.streaming import StreamedQueries
from mbtf_fit.material.decoder import Decoder
from mbtf_fit.material.inference import predict
from mbtf_fit.models.model import Model, Preparation
from mbtf_fit.models.registry import material_of, model_class
from mbtf_fit.native import kernel
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.noise import NoiseModel, typical_value, value_bound
from mbtf_fit.objective.parallel import MAX_KERNEL_THREADS, MAX_THREADS, Batch, Workers
from mbtf_fit.ops import Lookup
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.pytorch.textures import annealed_sigma
from mbtf_fit.sections import TrainingSection
from mbtf_fit.training.calibration import POINTS, fit_calibration
from mbtf_fit.training.suitable_data import open_data

TrainingData = TrainingQueries | TrainingImages | TrainingSlices | SharedSlices | StreamedQueries
# Decay rates of Adam's moments.
BETAS = (0.8, 0.95)
# Widest blur, in tile widths. A blur of half a tile made training unstable on textures of 16 × 16 texels: the
# offsets of three of eight fits diverged before the textures became sharp.
WIDEST_BLUR = 0.125
# Difference of fractional levels that rounding explains.
_SAME_LEVEL = 1e-4
# Rays per value from which on fewer points are used for the calibration.
_RAYS = 8
# Largest share of the budget that the warm-up takes.
_WARMUP_SHARE = 0.2
# Noise-to-signal ratio below which the decay of weights falls quadratically, so that few but clean queries
# are fitted without bias.
_REFERENCE_NOISE = 0.5
# Decay per noise-to-signal ratio over the number of queries: of weights that multiply what depends on the
# position, and of others; and the largest one.
_SPATIAL_WEIGHTS, _WEIGHTS, _MOST_DECAY = 2e5, 9e3, 1.0
# Decay of texels, and squared sigma of their blur, per noise-to-signal ratio over the number of queries per
# texel; and the largest decay.
_TEXELS, _BLUR, _MOST_TEXEL_DECAY = 150.0, 25.0, 50.0


def learning_rate_factor(training: TrainingSection, step: int, fraction: float) -> float:
    """Factor of the learning rates after a fraction of the budget: linear warm-up, then cosine decay.

    The warm-up takes a fifth of the budget at most: short fits would not reach the full rates otherwise.
    """
    rise = min(1.0, max((step + 1) / (training.warmup + 1), fraction / _WARMUP_SHARE))
    last = training.final_learning_rate_factor
    fall = last + (1 - last) * 0.5 * (1 + math.cos(math.pi * min(fraction, 1.0)))
    return rise * fall


@dataclass(frozen=True)
class Regularization:
    """What keeps a fit from learning the noise of its queries.

    After many epochs a network overfits the noise of few queries. Texels see few of them each: their decay,
    as the penalty of ridge regression (Hoerl and Kennard, Technometrics 12, 1970), and the area over which
    they are blurred grow with the noise-to-signal ratio over the number of queries per texel. Decay alone has
    no effect where the weights that multiply the texels grow instead, so these decay too, and those that
    multiply hints, which are large at few highlights. Decay of the other weights flattens the dependence on
    directions and removes colors, which are a small share of the loss: it is much smaller. Decays are applied
    to the parameters themselves, not to the gradients (Loshchilov and Hutter, ICLR 2019).

    Attributes
    ----------
    texels, spatial_weights, weights : decay per step, relative to the learning rate: of texels, of the
        network weights that multiply what depends on the position, and of all matrices
    min_sigma : minimum blur of the feature textures, in texels; at most that of the first step
    """

    texels: float
    spatial_weights: float
    weights: float
    min_sigma: float

    @classmethod
    def of(cls, training: TrainingSection, noise_ratio: float, queries: int, texels: int) -> Regularization:
        """For numbers of training queries, with a noise-to-signal ratio (of variances), and of texels that a
        network decodes."""
        strength = training.noise_regularization * noise_ratio / queries
        shared = strength * min(1.0, noise_ratio / _REFERENCE_NOISE)
        return cls(
            training.texture_weight_decay + min(_MOST_TEXEL_DECAY, _TEXELS * strength * texels),
            min(_MOST_DECAY, _SPATIAL_WEIGHTS * shared),
            min(_MOST_DECAY, _WEIGHTS * shared),
            math.sqrt(_BLUR * strength * texels),
        )

    def decay(self, model: NeuralMaterial, texture_rate: float, rate: float) -> None:
        """Decay a model's parameters by one step at these learning rates."""
        texels, weights = model.parameter_groups()
        # Biases do not decay: they keep the mean value.
        matrices = [p for p in weights if p.ndim > 1 and p.requires_grad]
        groups = (
            (texels, texture_rate * self.texels),
            (model.spatial_weights(), rate * self.spatial_weights),
            (matrices, rate * self.weights),
        )
        with torch.no_grad():
            for parameters, amount in groups:
                if amount > 0:
                    for p in parameters:
                        p.mul_(math.exp(-amount))


@dataclass
class TrainingProgress:
    """Progress of training: steps done, seconds spent in them over all runs, mean loss of the last steps."""

    step: int = 0
    seconds: float = 0.0
    loss: float = math.nan


class Trainer:
    """Training of one model on one set of queries.

    Parameters
    ----------
    model : initialized, on the device
    queries : on the device
    noise : model of their noise
    hooks : the model of the material, prepared; by default that of the configuration

    Attributes
    ----------
    progress : steps done; shared with the trainers of other materials that are trained in turn
    """

    def __init__(
        self,
        config: FitConfig,
        model: NeuralMaterial,
        queries: TrainingData,
        noise: NoiseModel,
        hooks: Model | None = None,
    ) -> None:
        self.config = config
        self.model = model
        self.hooks = model_class(config.model)(model) if hooks is None else hooks
        if isinstance(queries, TrainingImages):
            queries = replace(queries, patch_size=config.training.patch_size)
        self.queries: TrainingData = self.hooks.precompute(queries, config.data.memory)
        self.device = next(model.parameters()).device
        self.progress = TrainingProgress()
        self.batch = min(config.training.batch, len(queries))
        texels, weights = self.hooks.trained()
        if config.training.residual_levels:
            model.textures()[0].make_residual()
        self.noise = noise
        self.loss = Objective(config.training, noise)
        # Texels of `svbrdf` are its parameters: decay would move them towards an arbitrary material.
        count = len(model.textures()[0].texels) if model.networks() else 0
        self.regularization = Regularization.of(config.training, noise.ratio, len(queries), count)
        found, groups = kernel(), [texels, weights]
        self.optimizer: Adam | torch.optim.Adam
        self._stepper: NativeStepper | None = None
        if found is not None and supports(model):
            self.optimizer = Adam(groups, BETAS)
            self._stepper = NativeStepper(found, model, self.optimizer)
        else:
            self.optimizer = torch.optim.Adam([{"params": g} for g in groups], betas=BETAS, fused=True)

    @property
    def backend(self) -> str:
        """``kernel`` and its instruction set, or ``pytorch``."""
        return "pytorch" if self._stepper is None else f"kernel {self._stepper.kernel.name}"

    @property
    def max_threads(self) -> int:
        """Most threads that share a batch."""
        return MAX_THREADS if self._stepper is None else MAX_KERNEL_THREADS

    @property
    def fraction(self) -> float:
        """Fraction of the budget that is spent, in [0, 1]."""
        training = self.config.training
        if training.steps is not None:
            return min(1.0, self.progress.step / training.steps)
        return training.time.spent(self.progress.seconds, self.progress.step)

    def steps(self, workers: Workers, first: int) -> Iterator[Tensor]:
        """Endless steps from the batch of a number on; each yields its mean loss."""
        for batch in self.queries.batches(self.batch, self.config.seed, first, self.model.margin):
            yield self._step(batch, workers)

    def parameters(self) -> dict[str, Tensor]:
        """Parameters by name: of the material, and others that the model trains."""
        return {**dict(self.model.named_parameters()), **self.hooks.parameters()}

    def health(self) -> Tensor:
        """A number that is finite if all network weights are."""
        with torch.no_grad():
            sums = [p.sum() for p in self.hooks.trained()[1]]
            return torch.stack([torch.zeros((), device=self.device), *sums]).sum()

    def _sigmas(self) -> list[float]:
        """Current blur of each texture, in texels of the finest level."""
        blur, model = self.config.training.blur, self.model
        start = min(blur.initial_sigma, max(WIDEST_BLUR * min(model.lattice.shape()), blur.final_sigma))
        sigma = annealed_sigma(self.fraction / blur.fraction, start, blur.final_sigma)
        least = max(blur.min_sigma, min(self.regularization.min_sigma, start))
        return [max(sigma, blur.offset_sigma if t.moves_lookups else least) for t in model.textures()]

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
        self.regularization.decay(self.model, *rates)
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
        assert isinstance(self.optimizer, torch.optim.Adam)
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

    @property
    def calibrates(self) -> bool:
        """Whether the model gets calibration factors: it has some, and the configuration asks for them."""
        return self.config.training.energy_calibration and self.hooks.calibrates

    def calibrate(self, steps: int, progress: Callable[[float], None] = lambda fraction: None) -> None:
        """Fit the calibration factors (:mod:`~mbtf_fit.training.calibration`), if it :attr:`calibrates`; with
        at most a quarter as many evaluations as the queries of its `steps`, and at fewer points where many
        rays are traced for each. `progress` is called with the fraction that is done."""
        model = self.model
        if not self.calibrates:
            return
        assert isinstance(self.queries, TrainingQueries | StreamedQueries)
        self._read_blurred()
        model.calibrate(None)
        found = fit_calibration(
            partial(predict, model),
            model.lattice,
            self.queries,
            self.config.held_out,
            self.loss.bound,
            steps * self.batch // 4,
            progress,
            POINTS // max(1, model.rays // _RAYS),
        )
        model.calibrate(torch.from_numpy(found).to(self.device))

    def fill_levels(self, coarsest: float) -> None:
        """Give levels of the pyramid below the fractional level of the data's largest footprint the averages
        of the next finer one. Measured BTFs have one footprint: their coarser levels would keep their initial
        noise. Levels that are read beside those of the footprint are trained, too."""
        read = min((o.finer for o in self.model.operations if isinstance(o, Lookup)), default=0.0)
        pyramid, first = self.model.textures()[0], math.floor(coarsest + _SAME_LEVEL + read)
        if pyramid.residual and first > 0:
            # A blur and sums would mix the averages with finer levels.
            pyramid.settle(self._sigmas()[0])
        pyramid.average_coarser(first)

    def coverage(self) -> dict[int, float]:
        """Level → fraction of the pyramid's texels that have received gradients; those of residual levels
        also come from finer ones."""
        pyramid = self.model.textures()[0]
        if not self.hooks.trained()[0]:
            return dict.fromkeys(range(self.model.lattice.finest + 1), 1.0)
        moment = self.optimizer.state.get(pyramid.texels, {}).get("exp_avg_sq")
        return {
            s: 0.0 if moment is None else float((moment[a:b] > 0).any(1).float().mean())
            for s, (a, b) in enumerate(pairwise(pyramid.packing.starts))
        }


def prepare_trainer(
    config: FitConfig,
    data: Dataset,
    partition: Partition,
    device: torch.device,
    shared: NeuralMaterial | None = None,
) -> Trainer:
    """A trainer at its first step, for the model and the data of a configuration; with the networks of the
    model `shared`, if there is one."""
    model = material_of(config.model, data.lattice, config.network)
    values = mean_value(partition.sample.value_a, partition.sample.value_b)
    unit = typical_value(values)
    model.initialize(torch.Generator().manual_seed(config.seed), unit, value_bound(values, unit))

    def load(folder: str) -> tuple[TrainingData, float]:
        other = open_data(folder, config.model, config.data.cache)
        part = load_training(other, config.held_out, config.seed)
        typical = typical_value(mean_value(part.sample.value_a, part.sample.value_b))
        return part.training.to(device), typical

    hooks, training = model_class(config.model)(model), partition.training
    if isinstance(training, TrainingSlices) and hooks.layout == "shuffled":
        training = training.as_queries(data.lattice, config.seed)
    training = training.to(device)
    training = hooks.prepare(Preparation(data, training, config.training, unit, config.seed, load))
    if config.decoder is not None:
        Decoder.find(config.decoder).load(model)
    noise = NoiseModel.silent(unit, data.lattice)
    # A single value does not tell its noise; none is assumed.
    if data.estimates == 2:
        noise = NoiseModel.of(partition.sample, data.lattice, unit)
    model = model.to(device)
    if shared is not None:
        model.share_networks(shared)
    return Trainer(config, model, training, noise, hooks)

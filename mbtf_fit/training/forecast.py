"""Forecast of a fit: time and size, from some seconds of its training with the same data."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import torch

from mbtf_core.data.folder import DataFolder
from mbtf_core.data.lattice import Lattice
from mbtf_core.forecast import pilot_seconds
from mbtf_core.stats import Estimate
from mbtf_core.units import clock
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import load_training
from mbtf_fit.models.registry import material_of
from mbtf_fit.sections import TimeBudget
from mbtf_fit.surface.known import surface_bytes
from mbtf_fit.training.loop import TrainingLoop, choose_device, keep_freed_memory
from mbtf_fit.training.suitable_data import open_data
from mbtf_fit.training.trainer import prepare_trainer

# Seconds of the pilot, and of each of its pieces, whose rates give the error.
_PILOT_SECONDS, _PIECE_SECONDS = 5.0, 1.0
_ENDLESS = 1e9
# Seconds of a fit before its training and after it, and those of each query of its data: of the default model
# at 64 and 128 texels, on two cores.
_BEFORE, _AFTER = (3.0, 0.6e-6), (5.0, 0.1e-6)


def preparing_seconds(queries: float) -> float:
    """Expected seconds of a fit before training, for so many queries of data: start, reading, hints."""
    return _BEFORE[0] + _BEFORE[1] * queries


def closing_seconds(queries: float) -> float:
    """Expected seconds of a fit after training: energy calibration, errors, distillation, writing."""
    return _AFTER[0] + _AFTER[1] * queries


def fit_bytes(config: FitConfig, lattice: Lattice) -> int:
    """Bytes that a fit writes at most: a checkpoint of weights, two moments and the best weights, while it
    replaces another, and the known surface."""
    with torch.device("meta"):
        model = material_of(config.model, lattice, config.network)
    surface = surface_bytes(lattice) if model.tracing is not None else 0
    return 8 * sum(p.nbytes for p in model.parameters()) + surface


@dataclass(frozen=True)
class FitForecast:
    """Expected cost of a fit: seconds of training and their standard error, of loading before and of closing
    after it, training steps and queries per second, and bytes of the material's numbers."""

    seconds: float
    seconds_se: float
    loading: float
    closing: float
    steps: int
    queries_per_second: float
    bytes: int

    def describe(self) -> str:
        """Lines."""
        error = f" ± {clock(self.seconds_se)}" if self.seconds_se >= 0.5 else ""
        closing = f"about {self.closing:.0f} s of calibration and errors after"
        beside = f"{self.loading:.0f} s of reading before, {closing}"
        return (
            f"forecast: {clock(self.seconds)}{error} of training, {self.steps} steps at "
            f"{self.queries_per_second / 1e6:.2f} M queries/s; {beside}; {self.bytes / 1e6:.2f} MB"
        )


def forecast_fit(config: FitConfig, shards: str | Path | DataFolder) -> FitForecast:
    """Forecast the fit of a configuration by a few seconds of its training; nothing is written.

    Raises
    ------
    InputError : the data set cannot be read, or suits another model
    """
    began = time.perf_counter()
    data = open_data(shards, config.model, config.data.cache)
    keep_freed_memory()
    partition = load_training(data, config.held_out, config.seed, config.data.memory)
    pilot = {"training": config.training.model_copy(update={"time": TimeBudget(_ENDLESS), "steps": None})}
    device = choose_device(config.device)
    trainer = prepare_trainer(config.model_copy(update=pilot), data, partition, device)
    loading = time.perf_counter() - began
    loop = TrainingLoop([trainer])
    # In the middle of the annealing, whose steps take as long as the average.
    loop.progress.seconds = 0.5 * config.training.blur.fraction * _ENDLESS

    def piece(number: int) -> int:
        before = loop.progress.step
        loop.train(_PIECE_SECONDS)
        return loop.progress.step - before

    step = pilot_seconds(piece, _PILOT_SECONDS)
    asked, budget = config.training.steps, config.training.time
    total = step.scaled(budget.min_steps if asked is None else asked)
    if asked is None and total.value < budget.seconds:
        total = Estimate(budget.seconds, 0.0, 1)
    steps = round(total.value / step.value) if asked is None else asked
    return FitForecast(
        seconds=total.value,
        seconds_se=total.error,
        loading=loading,
        closing=closing_seconds(len(partition.training)),
        steps=steps,
        queries_per_second=trainer.batch / step.value,
        bytes=sum(tensor.nbytes for tensor in trainer.model.weights().values()),
    )

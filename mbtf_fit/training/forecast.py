"""Forecast of a fit: time and size, from a few seconds of training with the same data."""

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
from mbtf_fit.data.loader import load_training, open_data
from mbtf_fit.models.registry import MODELS, material_of
from mbtf_fit.surface.known import surface_bytes
from mbtf_fit.training.loop import TrainingLoop, choose_device, keep_freed_memory
from mbtf_fit.training.trainer import prepare_trainer

# Seconds of the pilot, and of each of its pieces, whose rates give the error.
_PILOT_SECONDS, _PIECE_SECONDS = 5.0, 1.0
_ENDLESS = 1e9
# Seconds of a fit besides training (loading, calibration, evaluation), and of each query of its data.
_FIT_SECONDS, _QUERY_SECONDS = 4.0, 1.1e-6


def evaluation_seconds(queries: float) -> float:
    """Seconds of a fit besides training, for so many queries of data."""
    return _FIT_SECONDS + _QUERY_SECONDS * queries


def fit_bytes(config: FitConfig, lattice: Lattice) -> int:
    """Bytes that a fit writes at most: a checkpoint of weights and two moments, while it replaces another,
    and the known surface."""
    with torch.device("meta"):
        model = material_of(config.model, lattice, config.network)
    surface = surface_bytes(lattice) if model.tracing is not None else 0
    return 6 * sum(p.nbytes for p in model.parameters()) + surface


@dataclass(frozen=True)
class FitForecast:
    """Expected cost of a fit: seconds of training and their standard error, seconds of loading, training
    steps and queries per second, and bytes of the material's numbers."""

    seconds: float
    seconds_se: float
    loading: float
    steps: int
    queries_per_second: float
    bytes: int

    def describe(self) -> str:
        """One line."""
        error = f" ± {clock(self.seconds_se)}" if self.seconds_se else ""
        return (
            f"forecast: {clock(self.seconds)}{error} of training, {self.steps} steps at "
            f"{self.queries_per_second / 1e6:.2f} M queries/s, after {self.loading:.0f} s of loading; "
            f"{self.bytes / 1e6:.2f} MB"
        )


def forecast_fit(config: FitConfig, shards: str | Path | DataFolder) -> FitForecast:
    """Forecast the fit of a configuration by its first seconds; nothing is written.

    Parameters
    ----------
    config : FitConfig
    shards : str, Path or DataFolder
        Data set.

    Returns
    -------
    FitForecast

    Raises
    ------
    InputError
        The data set cannot be read, or suits another model.
    """
    began = time.perf_counter()
    data = open_data(shards, MODELS[config.model].layout, config.model, config.data.cache)
    keep_freed_memory()
    partition = load_training(data, config.held_out, config.seed, config.data.memory)
    loading = time.perf_counter() - began
    pilot = {"training": config.training.model_copy(update={"time": _ENDLESS, "steps": None})}
    device = choose_device(config.device)
    trainer = prepare_trainer(config.model_copy(update=pilot), data, partition, device)
    loop = TrainingLoop([trainer])
    # In the middle of the annealing, whose steps take as long as the average.
    loop.progress.seconds = 0.5 * config.training.blur.fraction * _ENDLESS

    def piece(number: int) -> int:
        before = loop.progress.step
        loop.train(_PIECE_SECONDS)
        return loop.progress.step - before

    step = pilot_seconds(piece, _PILOT_SECONDS)
    steps = config.training.steps
    total = step.scaled(config.training.min_steps if steps is None else steps)
    if steps is None and total.value < config.training.time:
        total = Estimate(config.training.time, 0.0, 1)
    return FitForecast(
        seconds=total.value,
        seconds_se=total.error,
        loading=loading,
        steps=round(total.value / step.value) if steps is None else steps,
        queries_per_second=trainer.batch / step.value,
        bytes=sum(tensor.nbytes for tensor in trainer.model.weights().values()),
    )

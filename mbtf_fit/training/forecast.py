"""Forecast of a fit: time, size, and an upper bound of its error, from a short fit of the same data."""

from __future__ import annotations

import math
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
from mbtf_fit.data.loader import Partition, load_training, open_data
from mbtf_fit.formatting import SPLIT_NAMES
from mbtf_fit.models.registry import MODELS, material_of
from mbtf_fit.surface.known import surface_bytes
from mbtf_fit.training.device import choose_device, keep_freed_memory
from mbtf_fit.training.fit import prepare_trainer
from mbtf_fit.training.trainer import Trainer
from mbtf_fit.training.validation import validation_error, validation_set, validation_subset

# Seconds of the pilot of a forecast, and of one that only times steps.
PILOT_SECONDS, _STEPS_PILOT = 8.0, 2.0
# Pieces of the training time whose rates give its error.
_PIECES = 4
# Seconds of a fit besides training (loading, calibration, evaluation), and of each query of its data.
_FIT_SECONDS, _QUERY_SECONDS = 4.0, 1.1e-6
# Fits of fewer queries in all steps take less than a minute at a third of a million queries per second.
LONG_FIT = 20_000_000
# Most queries of the validation subset.
_SUBSET = 1 << 17


def evaluation_seconds(queries: float) -> float:
    """Seconds of a fit besides training, for so many queries of data."""
    return _FIT_SECONDS + _QUERY_SECONDS * queries


@dataclass(frozen=True)
class FitForecast:
    """Expected cost of a fit.

    Attributes
    ----------
    seconds, seconds_se : of training, and the standard error
    loading : seconds of reading the data
    steps : in the time of training
    queries_per_second : training throughput
    validation_set : the set of queries that the error is of, in words
    unexplained, unexplained_se : unexplained variance after the pilot, above that of a longer fit, and its
        standard error; None where there are no queries, or constant values
    bytes : of the material's numbers
    """

    seconds: float
    seconds_se: float
    loading: float
    steps: int
    queries_per_second: float
    validation_set: str
    unexplained: float | None
    unexplained_se: float | None
    bytes: int

    def describe(self) -> str:
        """One or two lines."""
        error = f" ± {clock(self.seconds_se)}" if self.seconds_se else ""
        text = (
            f"forecast: {clock(self.seconds)}{error} of training, {self.steps} steps at "
            f"{self.queries_per_second / 1e6:.2f} M queries/s, after {self.loading:.0f} s of loading; "
            f"{self.bytes / 1e6:.2f} MB"
        )
        if self.unexplained is None:
            return text
        return (
            f"{text}\nunexplained variance of {self.validation_set} after {clock(PILOT_SECONDS)}: "
            f"{self.unexplained:.2f} ± {self.unexplained_se:.2f}; longer training reduces it"
        )


def fit_bytes(config: FitConfig, lattice: Lattice) -> int:
    """Bytes that a fit writes at most: a checkpoint of weights and two moments, while it replaces another,
    and the known surface."""
    with torch.device("meta"):
        model = material_of(config.model, lattice, config.network)
    surface = surface_bytes(lattice) if model.tracing is not None else 0
    return 6 * sum(p.nbytes for p in model.parameters()) + surface


def training_seconds(config: FitConfig, shards: str | Path | DataFolder) -> tuple[float, Partition | None]:
    """Seconds that a fit trains, and the data where they were loaded: a number of steps is timed by a pilot,
    unless no machine needs a minute."""
    steps, batch = config.training.steps, config.training.batch
    if steps is None:
        return config.training.time, None
    if steps * batch < LONG_FIT:
        return 0.0, None
    data = open_data(shards, MODELS[config.model].layout, config.model, config.data.cache)
    keep_freed_memory()
    partition = load_training(data, config.held_out, config.seed, config.data.memory)
    trainer = prepare_trainer(config, data, partition, choose_device(config.device))
    return steps * _step_seconds(trainer, _STEPS_PILOT).value, partition


def forecast_fit(config: FitConfig, shards: str | Path | DataFolder) -> FitForecast:
    """Forecast the fit of a configuration by a short one, which runs the whole schedule; nothing is written.

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
    name, queries = validation_set(data, partition)
    loading = time.perf_counter() - began
    training = config.training.model_copy(update={"time": PILOT_SECONDS, "steps": None})
    pilot = config.model_copy(update={"training": training})
    trainer = prepare_trainer(pilot, data, partition, choose_device(config.device))
    each = _step_seconds(trainer, PILOT_SECONDS)
    while not trainer.train(math.inf):
        pass
    error = None
    if len(subset := validation_subset(trainer.model.positions, queries, _SUBSET)):
        found = validation_error(trainer, subset)
        error = found if math.isfinite(found.value) else None
    steps = config.training.steps
    total = Estimate(config.training.time, 0.0, 1) if steps is None else each.scaled(steps)
    return FitForecast(
        seconds=total.value,
        seconds_se=total.error,
        loading=loading,
        steps=round(total.value / each.value) if steps is None else steps,
        queries_per_second=trainer.batch / each.value,
        validation_set=SPLIT_NAMES[name],
        unexplained=None if error is None else error.value,
        unexplained_se=None if error is None else error.error,
        bytes=sum(tensor.nbytes for tensor in trainer.model.weights().values()),
    )


def _step_seconds(trainer: Trainer, seconds: float) -> Estimate:
    """Seconds of a training step, from pieces of a training time."""

    def piece(number: int) -> int:
        before = trainer.progress.step
        trainer.train(seconds / _PIECES)
        return max(1, trainer.progress.step - before)

    return pilot_seconds(piece, seconds * (1.0 - 1.5 / _PIECES))

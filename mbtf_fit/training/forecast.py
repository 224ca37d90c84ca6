"""Forecast of a fit: time, error and size, extrapolated from two short fits of the same data."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from mbtf_core.lattice import Lattice
from mbtf_core.units import clock
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import Partition, load_training, open_data
from mbtf_fit.formatting import SPLIT_NAMES
from mbtf_fit.models.registry import MODELS, material_of
from mbtf_fit.surface.known import surface_bytes
from mbtf_fit.training.device import choose_device, keep_freed_memory
from mbtf_fit.training.fit import prepare_trainer
from mbtf_fit.training.validation import validation_error, validation_set, validation_subset

# Training times of the two pilot fits in seconds; each runs the whole schedule.
PILOT_SECONDS = (4.0, 8.0)
# Each doubling of the time improves the logarithm of the error by this share of the improvement before. Least
# squares over fits of 60 s with quality options on draft data of eleven materials
# (benchmarks/forecasts.py).
PERSISTENCE = 0.45
# Seconds of a fit besides training (loading, calibration, evaluation), of each query of its data, and of each
# query's transmittance, on two processor cores (benchmarks/quality.py, benchmarks/time_against_presets.py).
FIT_SECONDS, _QUERY_SECONDS, _TRANSMITTANCE_SECONDS = 4.0, 1.1e-6, 0.4e-6
# Fits of fewer queries in all steps take less than a minute at a third of a million queries per second.
LONG_FIT = 20_000_000
# Seconds of the pilot of a fit by steps.
_STEPS_PILOT = 2.0
# Most queries of the validation subset.
_SUBSET = 1 << 17


def query_seconds(transmittance: bool) -> float:
    """Seconds of loading and evaluating a query of data with or without a transmittance."""
    return _QUERY_SECONDS + (_TRANSMITTANCE_SECONDS if transmittance else 0.0)


@dataclass(frozen=True)
class FitForecast:
    """Expected cost and error of a fit.

    Attributes
    ----------
    seconds : of training; loading : of reading the data
    steps : in that time
    queries_per_second : training throughput
    validation_set : the set of queries that the errors are of, in words
    unexplained : expected unexplained variance; None where there are no queries, or constant values
    at_most : that after the longer pilot
    pilots : that after each pilot; empty where there is none
    bytes : of the material's numbers
    pilot_seconds : time of the forecast, loading included
    """

    seconds: float
    loading: float
    steps: int
    queries_per_second: float
    validation_set: str
    unexplained: float | None
    at_most: float | None
    pilots: tuple[float, ...]
    bytes: int
    pilot_seconds: float

    def describe(self) -> str:
        """Two lines."""
        text = (
            f"forecast: {clock(self.seconds)} of training, {self.steps} steps at "
            f"{self.queries_per_second / 1e6:.2f} M queries/s, after {self.loading:.0f} s of loading; "
            f"{self.bytes / 1e6:.2f} MB"
        )
        if self.unexplained is not None:
            text += (
                f"\nexpected unexplained variance of {self.validation_set}: about {self.unexplained:.2f}, "
                f"and {self.at_most:.2f} after {clock(PILOT_SECONDS[1])}"
            )
        return text


def extrapolated(
    short: float, long: float, doublings: float, *, apart: float = 1.0, persistence: float = PERSISTENCE
) -> float:
    """Error after so many doublings of the longer fit's time, from the errors of two fits that are `apart`
    doublings apart. Each doubling improves the logarithm of the error by `persistence` of the improvement
    before. Never above the longer fit's error."""
    improvement = max(0.0, math.log(short / long)) if min(short, long) > 0 else 0.0
    ratio = persistence**apart / (1.0 - persistence**apart)
    return long * math.exp(-improvement * ratio * (1.0 - persistence ** max(doublings, 0.0)))


def fit_bytes(config: FitConfig, lattice: Lattice) -> int:
    """Bytes that a fit writes at most: a checkpoint of weights and two moments, while it replaces another,
    and the known surface."""
    with torch.device("meta"):
        model = material_of(config.model, lattice, config.network)
    surface = surface_bytes(lattice) if model.tracing is not None else 0
    return 6 * sum(p.nbytes for p in model.parameters()) + surface


def training_seconds(config: FitConfig, shards: str | Path) -> tuple[float, Partition | None]:
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
    trainer.train(_STEPS_PILOT)
    return steps * trainer.progress.seconds / trainer.progress.step, partition


def forecast_fit(config: FitConfig, shards: str | Path) -> FitForecast:
    """Forecast the fit of a configuration by two pilot fits; nothing is written."""
    began = time.perf_counter()
    device = choose_device(config.device)
    data = open_data(shards, MODELS[config.model].layout, config.model, config.data.cache)
    keep_freed_memory()
    partition = load_training(data, config.held_out, config.seed, config.data.memory)
    name, queries = validation_set(data, partition)
    loading = time.perf_counter() - began
    errors: list[float] = []
    for seconds in PILOT_SECONDS:
        training = config.training.model_copy(update={"time": seconds, "steps": None})
        pilot = config.model_copy(update={"training": training})
        trainer = prepare_trainer(pilot, data, partition, device)
        while not trainer.train(math.inf):
            pass
        subset = validation_subset(trainer.model.positions, queries, _SUBSET)
        if len(subset):
            errors.append(validation_error(trainer, subset).value)
    if not all(map(math.isfinite, errors)):
        errors.clear()
    rate = trainer.progress.step / trainer.progress.seconds
    steps = config.training.steps
    total = config.training.time if steps is None else steps / rate
    doublings = math.log2(total / PILOT_SECONDS[1])
    return FitForecast(
        seconds=total,
        loading=loading,
        steps=round(total * rate) if steps is None else steps,
        queries_per_second=rate * trainer.batch,
        validation_set=SPLIT_NAMES[name],
        unexplained=extrapolated(errors[0], errors[1], doublings) if errors else None,
        at_most=errors[-1] if errors else None,
        pilots=tuple(errors),
        bytes=sum(tensor.nbytes for tensor in trainer.model.weights().values()),
        pilot_seconds=time.perf_counter() - began,
    )

"""What a fit will take and reach, from short fits of the same data on this very machine, before it starts."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mbtf_core.console import clock
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import load_training, open_data
from mbtf_fit.formatting import SPLIT_NAMES
from mbtf_fit.models import MODELS
from mbtf_fit.training.fit import choose_device, glance_of, judging_queries, missed, prepare_trainer
from mbtf_fit.training.memory import keep_freed_memory

# Seconds of the two pilot fits; each runs through the whole schedule in its time.
PILOT_SECONDS = (4.0, 8.0)
# Every doubling of the time gains this share of what the one before gained, in the logarithm of the error:
# the model's size and the data end what training can reach. What suits fits of 60 s with the options of the
# qualities on data of a draft, of eleven materials; benchmarks/forecasts.py finds it anew.
PERSISTENCE = 0.45
# Judging queries at most: few rule the errors, and the fit will be judged by all.
_JUDGING = 1 << 17
# Bytes of a number in the material's file.
_NUMBER = 4


@dataclass(frozen=True)
class FitForecast:
    """What is expected of a fit.

    Attributes
    ----------
    seconds : of training; loading : of reading the data
    steps : that the time is enough for
    queries_per_second : trained on
    looks_at : the set of queries that errors are of, in words: the test split, or what was held out
    unexplained : variance of these that it will miss; None where there are none, or they do not vary
    at_most : the same after the longer pilot
    pilots : the same after each of them; empty where there is none
    bytes : of the material's numbers
    pilot_seconds : what the forecast took, loading included
    """

    seconds: float
    loading: float
    steps: int
    queries_per_second: float
    looks_at: str
    unexplained: float | None
    at_most: float | None
    pilots: tuple[float, ...]
    bytes: int
    pilot_seconds: float

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)

    def describe(self) -> str:
        """Two lines."""
        size = f"{self.bytes / 1e6:.2f} MB"
        lines = [
            f"forecast: {clock(self.seconds)} of training, {self.steps} steps at "
            f"{self.queries_per_second / 1e6:.2f} M queries/s, after {self.loading:.0f} s of loading; {size}"
        ]
        if self.unexplained is not None:
            lines.append(
                f"unexplained variance of {self.looks_at} about {self.unexplained:.2f}; "
                f"{self.at_most:.2f} after {clock(PILOT_SECONDS[1])}"
            )
        return "\n".join(lines)


def extrapolated(
    short: float, long: float, doublings: float, *, apart: float = 1.0, persistence: float = PERSISTENCE
) -> float:
    """Error after so many doublings of the longer fit's time, from those of two fits, `apart` doublings from
    each other, of which each gains `persistence` of what the one before gained, in the logarithm; never above
    the longer fit's, however short the budget."""
    gain = max(0.0, math.log(short / long)) if min(short, long) > 0 else 0.0
    ratio = persistence**apart / (1.0 - persistence**apart)
    return long * math.exp(-gain * ratio * (1.0 - persistence ** max(doublings, 0.0)))


def forecast_fit(config: FitConfig, shards: str | Path) -> FitForecast:
    """Fit twice, briefly, and say what the fit of a configuration will take; nothing is written.

    Raises
    ------
    InputError : shards cannot be used
    EngineError : the device is not there
    """
    began = time.perf_counter()
    device = choose_device(config.device)
    data = open_data(shards, MODELS[config.model].layout, config.model)
    keep_freed_memory()
    partition = load_training(data, config.held_out, config.seed, config.data.memory)
    looks_at, judging = judging_queries(data, partition)
    loading = time.perf_counter() - began
    found: list[float] = []
    for seconds in PILOT_SECONDS:
        training = config.training.model_copy(update={"time": seconds, "steps": None})
        pilot = config.model_copy(update={"training": training})
        trainer = prepare_trainer(pilot, data, partition, device)
        while not trainer.train(math.inf):
            pass
        judged = glance_of(trainer, judging, _JUDGING)
        if len(judged):
            found.append(missed(trainer, judged).value)
    if not all(map(math.isfinite, found)):
        found.clear()
    rate = trainer.progress.step / trainer.progress.seconds
    steps = config.training.steps
    total = config.training.time if steps is None else steps / rate
    numbers = sum(p.numel() for p in trainer.model.parameters())
    return FitForecast(
        seconds=total,
        loading=loading,
        steps=round(total * rate) if steps is None else steps,
        queries_per_second=rate * trainer.batch,
        looks_at=SPLIT_NAMES[looks_at],
        unexplained=extrapolated(found[0], found[1], math.log2(total / PILOT_SECONDS[1])) if found else None,
        at_most=found[-1] if found else None,
        pilots=tuple(found),
        bytes=_NUMBER * numbers,
        pilot_seconds=time.perf_counter() - began,
    )

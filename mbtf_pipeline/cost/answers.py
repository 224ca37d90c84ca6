"""What a time gives, and how long an error takes, by the runs of a cost study."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mbtf_core.stats import Estimate, Interval, LearningCurve
from mbtf_core.units import clock, format_duration
from mbtf_pipeline.cost.measurement import Measurement
from mbtf_pipeline.cost.runs import FEWEST_TOTALS, SLOW_SERIES

# Forecasts reach so many times beyond the work of the longest run.
FARTHEST = 4.0
# Total times that are forecast, in seconds, where they lie beyond the longest run by this factor.
_TIMES = (60.0, 120.0, 300.0, 600.0, 1200.0, 3600.0, 7200.0, 18000.0, 36000.0)
_BEYOND = 1.3
# Said where the bounds of a forecast are too far apart to plan by.
_INSUFFICIENT = "the evidence does not suffice"


def _work(run: Measurement) -> float:
    return run.details["generation_seconds"] + run.details["training_seconds"]


def is_significant(run: Measurement) -> bool:
    """Whether the error of a run exceeds its standard error; others are no evidence."""
    return run.error.value > 0 and run.error.error < run.error.value


@dataclass(frozen=True)
class Evidence:
    """Complete runs of a study with the same share of generating, the shortest first.

    Attributes
    ----------
    runs : their measurements, each the mean of its seeds
    deviation : relative standard deviation of a single run over seeds
    slow : runs of the fewest steps, which follow another law
    """

    runs: Sequence[Measurement]
    deviation: Estimate
    slow: Sequence[Measurement] = ()

    @classmethod
    def of(cls, found: Sequence[Measurement], deviation: Estimate) -> Evidence:
        """From the measurements of a study."""
        runs = [m for m in found if m.study == "run" and is_significant(m)]
        slow = [m for m in runs if m.series == SLOW_SERIES]
        runs = [m for m in runs if m.series != SLOW_SERIES]
        for series, _ in Counter(m.series for m in runs).most_common(1):
            runs = sorted((m for m in runs if m.series == series), key=_work)
        return cls(runs, deviation, slow)

    @cached_property
    def work(self) -> list[float]:
        """Seconds of generating and training; the error is a law of these."""
        return [_work(m) for m in self.runs]

    @cached_property
    def curve(self) -> LearningCurve | None:
        """The law of their errors; None where they are too few."""
        if len(self.runs) < FEWEST_TOTALS:
            return None
        errors, seeds = [m.error.value for m in self.runs], [m.details["seeds"] for m in self.runs]
        test = statistics.median(m.details["test_error"] for m in self.runs)
        return LearningCurve(self.work, errors, self.deviation, seeds, test)

    @property
    def overhead(self) -> float:
        """Seconds of a run besides its work, which longer runs need no more of."""
        return statistics.median(m.seconds.value - w for m, w in zip(self.runs, self.work, strict=True))

    @property
    def farthest(self) -> float:
        """Longest total time that is forecast, in seconds."""
        return self.overhead + FARTHEST * self.work[-1]

    def error_after(self, seconds: float) -> Interval | None:
        """Forecast of the error after a total time; None where runs are too few, or the time is too long."""
        if self.curve is None or seconds > self.farthest:
            return None
        return self.curve.error_at(max(seconds - self.overhead, min(self.work)))

    def times(self) -> list[float]:
        """Total times to forecast: one at least."""
        if self.curve is None:
            return []
        shortest = _BEYOND * self.runs[-1].seconds.value
        return [t for t in _TIMES if shortest <= t <= self.farthest] or [self.farthest]

    def time_of(self, error: float) -> str:
        """Forecast of the time of an error, in one line."""
        curve = self.curve
        if curve is None:
            return f"error {error:g}: runs of {FEWEST_TOTALS} lengths are needed to forecast its time"
        found, least = curve.time_of(error), self.overhead
        time = Interval(found.value + least, found.low + least, found.high + least)
        if self.farthest < time.value < math.inf:
            return f"error {error:g}: takes more than {clock(self.farthest)}, where the forecast ends"
        if time.suffices:
            span = f"{clock(time.low)} to {clock(time.high)}"
            return f"error {error:g}: about {clock(time.value)} ({span})"
        if time.low == math.inf:
            # The data of a study's runs grow with their time.
            why = "with this network, however many queries"
            return f"error {error:g}: not reachable {why}: they limit it at about {curve.limit}"
        return f"error {error:g}: {_INSUFFICIENT}, but it takes at least {clock(time.low)}"


def answers(evidence: Evidence) -> list[dict[str, Any]]:
    """What each time gives, measured or forecast: texts for page and console, and numbers for JSON."""
    rows = []
    for m in sorted((*evidence.slow, *evidence.runs), key=lambda m: m.seconds.value):
        spent = [m.details[f"{part}_seconds"] for part in ("generation", "training", "overhead")]
        basis = "measured: {:.0f} s generating, {:.0f} s training, {:.0f} s start-up and calibration".format(
            *spent
        )
        number = {"seconds": m.seconds.value, "unexplained": m.error.as_dict(), "forecast": False}
        rows.append(_row(clock(m.seconds.value), str(m.error), basis, number))
    for seconds in evidence.times():
        found = evidence.error_after(seconds)
        assert found is not None
        text = str(found) if found.suffices else _INSUFFICIENT
        basis = f"forecast, {seconds / evidence.runs[-1].seconds.value:.2g} times the longest run"
        time = format_duration(seconds) if seconds in _TIMES else clock(seconds)
        number = {"seconds": seconds, "unexplained": found.as_dict(), "forecast": True}
        rows.append(_row(time, text, basis, number))
    return rows


def _row(time: str, error: str, basis: str, number: dict[str, Any]) -> dict[str, Any]:
    line = f"{time}: unexplained variance {error}   {basis}"
    return {"time": time, "error": error, "basis": basis, "line": line, **number}

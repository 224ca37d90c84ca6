"""What a time is expected to give, and how long an error is expected to take, by the runs of a cost study."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mbtf_core.forecast import INSUFFICIENT, expected_error, expected_seconds
from mbtf_core.stats import Estimate, Interval, LearningCurve
from mbtf_core.units import clock, format_duration
from mbtf_pipeline.cost.measurement import Measurement

# Times of everything that the page answers, in seconds.
_TIMES = (60.0, 300.0, 900.0, 3600.0)
# What limits the error of a study's runs, whose data grow with their time.
_LIMITS = "with this network, however many queries"


@dataclass(frozen=True)
class Evidence:
    """Complete runs of a study with the same share of generating.

    Attributes
    ----------
    seconds, errors, seeds : total time, unexplained variance, and number of seeds of each
    work : seconds of generating and training, part of `seconds`; the error is a law of these
    deviation, degrees : relative deviation of a single run over seeds, and its degrees of freedom
    test : relative standard error by the test queries
    """

    seconds: tuple[float, ...]
    errors: tuple[float, ...]
    seeds: tuple[float, ...]
    work: tuple[float, ...]
    deviation: float
    degrees: float
    test: float

    @classmethod
    def of(cls, found: Sequence[Measurement], deviation: Estimate | None) -> Evidence:
        """From the measurements of a study."""
        runs = [m for m in found if m.study == "run" and m.error.value > 0 and m.error.error < m.error.value]
        for series, _ in Counter(m.series for m in runs).most_common(1):
            runs = sorted((m for m in runs if m.series == series), key=lambda m: m.seconds.value)
        return cls(
            tuple(m.seconds.value for m in runs),
            tuple(m.error.value for m in runs),
            tuple(m.details["seeds"] for m in runs),
            tuple(m.details["generation_seconds"] + m.details["training_seconds"] for m in runs),
            0.0 if deviation is None else deviation.value,
            0.0 if deviation is None else deviation.degrees,
            statistics.median([m.details["test_error"] for m in runs] or [0.0]),
        )

    @cached_property
    def curve(self) -> LearningCurve | None:
        """The law of their errors; None where they are too few."""
        deviation = Estimate(self.deviation, 0.0, 1, self.degrees) if self.degrees > 0 else None
        try:
            return LearningCurve(self.work, self.errors, deviation, self.seeds, self.test)
        except ValueError:
            return None

    @property
    def overhead(self) -> float:
        """Seconds of a run besides its work, which longer runs need no more of."""
        return statistics.median(s - w for s, w in zip(self.seconds, self.work, strict=True))

    def range_text(self, seconds: float) -> str:
        """Whether a time lies within those that were measured."""
        longest = self.seconds[-1]
        if seconds < 0.95 * self.seconds[0]:
            return f"extrapolated below the shortest run, {clock(self.seconds[0])}"
        if seconds <= 1.05 * longest:
            return f"measured: {len(self.seconds)} runs of {clock(self.seconds[0])} to {clock(longest)}"
        return f"extrapolated, {seconds / longest:.2g} times the longest run"

    def error_after(self, seconds: float) -> tuple[Interval, str] | None:
        """Expected error of a run of a time, and one line; None where the runs are too few, or all longer."""
        curve = self.curve
        if curve is None or seconds < 0.95 * self.seconds[0]:
            return None
        error = curve.error_at(max(seconds - self.overhead, min(self.work)))
        return error, f"{expected_error(seconds, error)} ({self.range_text(seconds)})"

    def time_of(self, error: float) -> tuple[Interval, str] | None:
        """Expected time of an error, and one line; None where the runs are too few."""
        curve = self.curve
        if curve is None:
            return None
        found, least = curve.time_of(error), self.overhead
        time = Interval(found.value + least, found.low + least, found.high + least)
        text = expected_seconds(error, time, curve.limit, _LIMITS)
        return time, f"{text} ({self.range_text(time.value)})" if time.suffices else text


def page_answers(evidence: Evidence) -> list[dict[str, Any]]:
    """Rows of the page: time, expected error, whether it is measured."""
    rows = []
    for seconds in _TIMES:
        if (found := evidence.error_after(seconds)) is not None:
            text = str(found[0]) if found[0].suffices else INSUFFICIENT
            basis = evidence.range_text(seconds)
            rows.append({"time": format_duration(seconds), "error": text, "basis": basis, "line": found[1]})
    return rows

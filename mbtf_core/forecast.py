"""Forecasts of time: a short pilot on this machine, its error, and its extrapolation to the whole work."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import numpy as np

from mbtf_core.stats import Estimate

# Fewest timed pieces of a pilot.
FEWEST_PIECES = 3
# Work of more seconds or bytes is announced before it begins.
LONG, LARGE = 60.0, 1e9


def pilot_seconds(piece: Callable[[int], float], seconds: float) -> Estimate:
    """Seconds of one unit of work: the median over timed pieces of it, for so many seconds and three at
    least. ``piece(number)``, from 1, does a piece and returns how many units of work it was."""
    times: list[float] = []
    began = time.perf_counter()
    while len(times) < FEWEST_PIECES or time.perf_counter() - began < seconds:
        start = time.perf_counter()
        units = piece(len(times) + 1)
        times.append(max(time.perf_counter() - start, 1e-9) / units)
    return median_estimate(times)


def median_estimate(times: Sequence[float]) -> Estimate:
    """Median of timings in seconds, which other work on the machine changes little. Its standard error
    follows from the median absolute deviation, as for a normal distribution."""
    middle = float(np.median(times))
    deviation = 1.4826 * float(np.median(np.abs(np.asarray(times) - middle)))
    return Estimate(middle, 1.2533 * deviation / math.sqrt(len(times)), len(times))


def is_long(seconds: float, size: float) -> bool:
    """Whether work of so many seconds, or of so many bytes on disk, is announced before it begins."""
    return seconds >= LONG or size >= LARGE

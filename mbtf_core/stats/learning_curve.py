"""Learning curves: the error of fits over their training time, extrapolated with its uncertainty.

A fit of time t is expected to have the error ``f(t) = A (φ + (1 - φ) (t/t₀)^-b)``, t₀ the longest measured
time: a power law that levels off at the fraction φ of the error A that was measured last (Hestness et al.,
arXiv:1712.00409). Intervals are profile likelihoods of this model, so they contain every level at which the
measured errors could level off: a pure power law is the lower end, an error that falls no further often the
upper one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.stats.estimate import Estimate

# Coverage of the intervals.
COVERAGE = 0.95
# Shapes of the curve: exponents, and levels relative to the last error. Gradient descent on noisy data has no
# exponent above 1; of a transient we allow 2.
_POWERS = np.geomspace(0.02, 2.0, 560)
_LEVELS = np.concatenate(
    [[0.0], np.geomspace(1e-3, 0.02, 8), np.linspace(0.04, 0.98, 48), [0.99, 0.995, 1.0]]
)
_PARAMETERS = 3
# An interval whose ends have a larger ratio does not answer a question. With a smaller bound, those that are
# too narrow by chance would be shown more often than others.
_WIDEST = 30.0


@dataclass(frozen=True)
class Interval:
    """A predicted number and its bounds, which may be infinite; ``str()`` gives ``0.08 (0.06 to 0.11)``."""

    value: float
    low: float
    high: float

    @property
    def suffices(self) -> bool:
        """Whether the bounds are close enough to be an answer."""
        return 0 < self.low < math.inf and self.high <= _WIDEST * self.low

    def as_dict(self) -> dict[str, float | None]:
        """Plain data for JSON; None for infinite numbers."""
        numbers = {"value": self.value, "low": self.low, "high": self.high}
        return {name: number if math.isfinite(number) else None for name, number in numbers.items()}

    def __str__(self) -> str:
        return f"{self.value:.2g} ({self.low:.2g} to {self.high:.2g})"


class LearningCurve:
    """The errors that fits of other times may have, given those of some.

    Parameters
    ----------
    times : (n,) array_like
        Training times, in any unit.
    errors : (n,) array_like
        Their errors, positive.
    deviation : Estimate, optional
        Relative standard deviation of a single fit, from repeats; the scatter about the curve adds to it.
    counts : (n,) array_like, optional
        Fits of which each error is the mean; 1 by default.
    shared : float
        Relative standard error that all errors share: that of their common test queries.

    Raises
    ------
    ValueError
        Too few errors, equal times, or errors that are not positive and finite.
    """

    def __init__(
        self,
        times: ArrayLike,
        errors: ArrayLike,
        deviation: Estimate | None = None,
        counts: ArrayLike | None = None,
        shared: float = 0.0,
    ) -> None:
        t, e = np.asarray(times, float), np.asarray(errors, float)
        w = np.ones_like(t) if counts is None else np.asarray(counts, float)
        known = 0.0 if deviation is None else deviation.degrees
        degrees = len(t) - _PARAMETERS + known
        if len(t) < _PARAMETERS or degrees < 1 or not np.all(np.isfinite(e) & (e > 0)) or np.ptp(t) == 0:
            raise ValueError("a learning curve takes positive errors of at least four fits, of several times")
        from scipy.special import stdtrit

        self.last = float(t.max())
        b, level = (grid.ravel() for grid in np.meshgrid(_POWERS, _LEVELS, indexing="ij"))
        fall = np.repeat((t / self.last) ** -_POWERS[:, None], len(_LEVELS), axis=0)
        shape = np.log(level[:, None] + (1.0 - level[:, None]) * fall)
        residual = np.log(e) - shape
        scale = (residual * w).sum(1) / w.sum()
        squares = ((residual - scale[:, None]) ** 2 * w).sum(1)
        variance = squares.min() + (0.0 if deviation is None else known * deviation.value**2)
        # Exactly equal errors have no scatter, but numbers are rounded.
        variance = max(variance / degrees, 1e-12)
        excess = (squares - squares.min()) / variance
        allowed = float(stdtrit(degrees, 0.5 + 0.5 * COVERAGE)) ** 2
        inside = excess <= allowed
        self._power, self._level, self._scale = b[inside], level[inside], scale[inside]
        # For each shape the factor A is known with a margin of its own.
        self._margin = np.sqrt((allowed - excess[inside]) * variance / w.sum())
        density = (1.0 + excess[inside] / degrees) ** (-0.5 * (degrees + 1))
        # Uniform in the exponent, not in its logarithm.
        self._weight = density * self._power
        self._shared = float(stdtrit(1e9, 0.5 + 0.5 * COVERAGE)) * shared

    def _median(self, values: NDArray[np.float64]) -> float:
        """Weighted median of a number of each shape."""
        order = np.argsort(values)
        total = np.cumsum(self._weight[order])
        return float(values[order][np.searchsorted(total, 0.5 * total[-1])])

    def _widened(self, values: NDArray[np.float64]) -> Interval:
        """Interval of errors, from the logarithms of each shape."""
        low, high = float((values - self._margin).min()), float((values + self._margin).max())
        middle = min(max(self._median(values), low), high)
        bounds = (
            middle + side * math.hypot(middle - end, self._shared) for side, end in ((-1, low), (1, high))
        )
        return Interval(*(math.exp(x) for x in (middle, *bounds)))

    def error_at(self, time: float) -> Interval:
        """Error of a fit of a time."""
        fall = (time / self.last) ** -self._power
        return self._widened(self._scale + np.log(self._level + (1.0 - self._level) * fall))

    @property
    def limit(self) -> Interval:
        """Error that no time undercuts; the lower bound is 0 where none is known."""
        some = self._level > 0
        if not some.any():
            return Interval(0.0, 0.0, 0.0)
        values = np.where(some, self._scale + np.log(np.maximum(self._level, 1e-300)), -700.0)
        found = self._widened(values)
        low = 0.0 if not some.all() else found.low
        return Interval(found.value if found.value > 1e-12 else 0.0, low, found.high)

    def time_of(self, error: float) -> Interval:
        """Time of a fit that reaches an error; bounds and value are infinite where none may."""
        ends = []
        for side in (1.0, 0.0, -1.0):
            margin = np.hypot(self._margin, self._shared) * side
            relative = np.exp(math.log(error) - self._scale + margin) - self._level
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                times = np.log(relative / (1.0 - self._level)) / -self._power
            ends.append(np.where(relative > 0, np.where(self._level < 1, times, -np.inf), np.inf))
        start = math.log(self.last)
        low, high = float(ends[0].min()) + start, float(ends[2].max()) + start
        middle = self._median(ends[1]) + start
        numbers = (min(max(middle, low), high), low, high)
        return Interval(*(math.exp(x) if x < 700 else math.inf for x in numbers))

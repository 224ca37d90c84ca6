"""Forecast of a fit's error: complete fits of a small part of its steps, and the law of their errors.

Each pilot fit has the whole schedule of learning rate and blur, because the error falls most towards its end.
Pilots see each query less often than the fit, so they do not show whether it will overfit. A last pilot does:
it sees so few of the queries that it repeats them as often as the fit will. Its excess over the pilot with
all queries bounds that of the fit, which has more queries to generalize from.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.forecast import expected_error, expected_seconds
from mbtf_core.stats import (
    Estimate,
    Interval,
    LearningCurve,
    mse_difference,
    signal_variance,
    unexplained_variance,
)
from mbtf_fit.data.queries import ShardQueries, TrainingQueries
from mbtf_fit.training.loop import TrainingLoop, restore, snapshot
from mbtf_fit.training.trainer import TrainingProgress

# Pilots together take this share of the fit's steps, but each of them at least the warm-up; there is no
# forecast if that takes more than the larger share.
_SHARE, _MOST = 0.1, 0.5
# Steps of the pilots relative to the first one, and of the last one, which repeats few queries.
_LENGTHS = np.geomspace(1.0, 4.0, 6)
# Standard errors that make overfitting significant.
_SIGNIFICANT = 2.0
_NONE = Estimate(0.0, 0.0, 0)


@dataclass(frozen=True)
class ErrorForecast:
    """Expected error of a fit.

    Attributes
    ----------
    seconds : of training, as asked
    error : unexplained variance after them; None where nothing is known
    asked : error that is asked for, and time that reaches it; None where none is
    limit : error that no training time undercuts
    excess : error that overfitting adds at most, part of the upper bound of `error`, and its standard error
    repeats : how often the fit sees each query
    reason : why nothing is known
    """

    seconds: float
    error: Interval | None = None
    asked: tuple[float, Interval] | None = None
    limit: Interval | None = None
    excess: Estimate = _NONE
    repeats: float = 0.0
    reason: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        asked = None if self.asked is None else {"error": self.asked[0], "seconds": self.asked[1].as_dict()}
        intervals = {"error": self.error, "limit": self.limit}
        known = {name: found and found.as_dict() for name, found in intervals.items()}
        numbers = {"seconds": self.seconds, "excess": self.excess.as_dict(), "repeats": self.repeats}
        return {**numbers, **known, "asked": asked, "reason": self.reason}

    def describe(self) -> str:
        """A line for the error after the time, and one for the time of an error."""
        if self.error is None or self.limit is None:
            return f"no forecast of the error: {self.reason}"
        lines = [expected_error(self.seconds, self.error)]
        excess = self.excess
        if excess.value > max(0.5 * (self.error.high - self.error.value), _SIGNIFICANT * excess.error):
            lines.append(
                f"overfitting decides: the fit sees each query {self.repeats:.0f} times; more queries help, "
                "longer training may not"
            )
        if self.asked is not None:
            within = self.seconds if self.error.high <= self.asked[0] else math.inf
            why = "with these queries and this network"
            lines.append(expected_seconds(*self.asked, self.limit, why, within=within))
        return "\n".join(lines)


def forecast_error(loop: TrainingLoop, queries: ShardQueries, step: Estimate, steps: int) -> ErrorForecast:
    """Forecast the error of a fit from pilots on this machine.

    Parameters
    ----------
    loop : of one material, at its first step; left in another state
    queries : validation subset
    step : seconds of a training step
    steps : steps of the fit

    Returns
    -------
    ErrorForecast
    """
    (trainer,) = loop.trainers
    config, data, usual = trainer.config, trainer.queries, trainer.regularization
    total, seconds = float(_LENGTHS.sum() + _LENGTHS[-1]), steps * step.value
    first = max(_SHARE * steps / total, config.training.warmup, 2.0)
    if not isinstance(data, TrainingQueries):
        return ErrorForecast(seconds, reason="its queries are no shuffled ones in memory")
    if first * total > _MOST * steps:
        reason = f"{steps} steps are too few for a forecast by a part of them"
        return ErrorForecast(seconds, reason=reason)
    start = snapshot(loop)

    def pilot(count: int, seed: int) -> NDArray[np.float32]:
        restore(loop, start, TrainingProgress())
        trainer.model.calibrate(None)
        training = config.training.model_copy(update={"steps": count, "error": None})
        trainer.config = config.model_copy(update={"training": training, "seed": config.seed + seed})
        loop.train(float("inf"))
        trainer.calibrate(count)
        return trainer.predict(queries)

    counts = [round(first * length) for length in _LENGTHS]
    try:
        predictions = [pilot(count, number) for number, count in enumerate(counts)]
        few = min(len(data), max(trainer.batch, len(data) * counts[-1] // steps))
        trainer.queries = data.slice(0, few)
        trainer.regularization = trainer.regularization_of(few)
        repeated = pilot(counts[-1], len(counts))
    except InputError as diverged:
        return ErrorForecast(seconds, reason=diverged.message.splitlines()[0])
    finally:
        trainer.config, trainer.queries, trainer.regularization = config, data, usual
    found = [unexplained_variance(prediction, *queries.halves) for prediction in predictions]
    shared = float(np.median([e.relative_error for e in found]))
    try:
        curve = LearningCurve(counts, [e.value for e in found], shared=shared)
    except ValueError:
        return ErrorForecast(seconds, reason="the test queries do not resolve the errors of short fits")
    added = mse_difference(repeated, predictions[-1], *queries.halves)
    added = added.scaled(1.0 / signal_variance(*queries.halves).value)
    excess = replace(added, value=max(0.0, added.value))
    error = curve.error_at(steps)
    asked = None
    if (target := config.training.error) is not None:
        time = curve.time_of(target)
        # What overfitting may add must be trained away elsewhere.
        worst = curve.time_of(target - excess.value).high if excess.value < target else float("inf")
        scaled = replace(time, high=max(time.high, worst))
        asked = target, Interval(*(x * step.value for x in (scaled.value, scaled.low, scaled.high)))
    return ErrorForecast(
        seconds,
        replace(error, high=error.high + excess.value),
        asked,
        curve.limit,
        excess,
        steps * trainer.batch / len(data),
    )

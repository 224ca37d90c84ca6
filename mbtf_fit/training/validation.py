"""Validation during training: the set, the error on it, what longer training would gain, and the part that is
overfitting."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_core.stats import SIGNIFICANT, unexplained_variance
from mbtf_fit.data.loader import Partition, load_split
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.formatting import above_one
from mbtf_fit.training.best_state import excess_error
from mbtf_fit.training.endings import kept_step
from mbtf_fit.training.trainer import Trainer

# Queries of the validation subset, and the fewest queries of the test split that are preferred over others.
_SUBSET, _FEWEST = 1 << 14, 1 << 12


def validation_set(data: Dataset, partition: Partition) -> tuple[str, ShardQueries]:
    """(name among the errors, queries) of the set on which the error is tracked.

    The test split, because it has more paths per query: four paths often do not resolve the error of glossy
    materials. Those of the train split where there is no test split, or a small one. No option is selected
    by it; an earlier state than the last is, where it is clearly better.
    """
    held_out = partition.held_out_queries
    test = load_split(data, "test") if "test" in data.splits and data.shards("test") else None
    if test is not None and len(test) >= min(len(held_out), _FEWEST):
        return "test", test
    return "held_out_queries", held_out


def validation_subset(positions: int, queries: ShardQueries) -> ShardQueries:
    """At most 16384 queries, evenly spread over the set; fewer for a model that reads its textures at many
    positions per query. A copy, so that the set itself can be released."""
    most = max(_SUBSET // positions, _SUBSET // 16)
    return queries.take(np.arange(0, len(queries), max(1, math.ceil(len(queries) / most))))


def finite(number: float | None) -> float | None:
    """A number, or None where it is not finite; JSON and plots have no others."""
    return number if number is not None and math.isfinite(number) else None


def history_record(
    trainer: Trainer,
    subset: ShardQueries,
    prediction: NDArray[np.float32],
    previous: NDArray[np.float32] | None = None,
) -> dict[str, Any]:
    """Progress and validation error of the current model.

    Parameters
    ----------
    trainer : of the model
    subset : validation queries
    prediction : their values (n, 3)
    previous : those of the record before, None for the first of a run: with them, the record has the standard
        error of the change since then, compared query by query
    """
    state = trainer.progress
    found: dict[str, Any] = {}
    change = None
    if len(subset):
        found = unexplained_variance(prediction, *subset.halves).as_dict()
        if previous is not None:
            change = finite(excess_error([prediction], [previous], [subset]).error)
    return {
        "step": state.step,
        "seconds": round(state.seconds, 3),
        "fraction": round(trainer.fraction, 5),
        "loss": state.loss,
        "unexplained": found.get("value"),
        "unexplained_error": found.get("error"),
        "change_error": change,
        "queries_per_second": round(state.step * trainer.batch / max(state.seconds, 1e-9)),
    }


# Fractions of the budget between which a record counts as the middle of training.
_MIDDLE = (0.35, 0.65)
# Fits of the default model: the error after N steps is about proportional to 1 + 50 / N. From 100 steps on,
# twice the steps follow this law within 0.1 of the logarithm. ``benchmarks/advice.py`` measures both rules.
_EARLY_STEPS, _LAW_SCATTER = 50.0, 0.1
# Of the reduction of the error's logarithm by the second half of training, twice the time gains half again:
# the other half is due to the falling learning rate. Standard deviation of this rule.
_LASTING, _LASTING_SCATTER = 0.5, 0.05
# Unexplained variance that noise leaves, over the noise-to-signal ratio per query of a texel.
_NOISE_ERROR = 6.0
# Expected remainder of the error below which a fit counts as not converged, and the steps from which the
# curve is believed.
_STEEP, _LAW_STEPS = 0.8, 100
# Below so many steps, twice the steps reduce the error by a tenth or more: in the mean over seven materials
# to 0.84 of it after 200 steps, to 0.92 after 400.
FEWEST_STEPS = 400
# Expected remainder of the error from which longer training hardly helps.
FLAT = 0.95
# Relative standard error of the validation above which it does not tell convergence.
_RESOLVED = 0.25


@dataclass(frozen=True)
class MarginalCost:
    """Convergence of the error at the end of training, and how much of it is overfitting.

    Attributes
    ----------
    doubling : expected error after twice the training time, over the present one; None where the validation
        error is too uncertain
    noise_share : share of the error on queries without training that is overfitting to the noise of the
        training queries; None where it is not significant
    steps : number of training steps
    kept_step : step of the state that is kept, if it is not the last: later, the fit overfitted
    noise : noise variance of the training queries over the variance of their values; None where unknown
    density : training queries per texel; None where the data hold images or slices
    noise_limit : share of the error that this noise leaves however long the training; 0 where unknown
    """

    doubling: float | None
    noise_share: float | None
    steps: int
    kept_step: int | None = None
    noise: float | None = None
    density: float | None = None
    noise_limit: float = 0.0

    def as_dict(self) -> dict[str, float | int | None]:
        """Plain data for JSON."""
        return asdict(self)

    @property
    def few(self) -> bool:
        """Whether so few steps ask for more, whatever the curve shows."""
        return self.steps < FEWEST_STEPS


def marginal_cost_of(
    history: list[dict[str, Any]], errors: dict[str, Any], training: Mapping[str, Any]
) -> MarginalCost | None:
    """Marginal cost of a finished fit, from the records of its history, its errors by split, and the record
    of its training, empty where unknown; None where the history is incomplete."""
    if not history or history[-1].get("fraction", 0.0) < 1.0:
        return None
    share = _noise_share(errors, training.get("noise_variance"))
    last, doubling, limit = history[-1], _doubling(history), 0.0
    ratio, density = training.get("noise_ratio"), training.get("queries_per_texel")
    if ratio and density:
        # An unknown error is about that of the mean value.
        reached = last["unexplained"] if _number(last["unexplained"]) and last["unexplained"] > 0.0 else 1.0
        limit = min(1.0, _NOISE_ERROR * ratio / density / reached)
    # Longer training reduces the rest.
    doubling = None if doubling is None else doubling ** (1.0 - limit)
    kept = kept_step(training)
    return MarginalCost(doubling, share, int(last["step"]), kept, ratio, density, limit)


def caveat(history: list[dict[str, Any]], training: Mapping[str, Any], unexplained: Mapping[str, Any]) -> str:
    """Why the error of a fit does not rank its model; empty where it does.

    Its error still falls steeply, or it has few steps where the history does not tell; or the unexplained
    variance is above 1.

    Parameters
    ----------
    history : records of the fit's validations
    training : record of its training
    unexplained : variance on test queries, value and error
    """
    steps, cost = training["steps"], marginal_cost_of(history, {}, training)
    doubling = None if cost is None or steps < _LAW_STEPS else cost.doubling
    falls = steps < FEWEST_STEPS if doubling is None else doubling < _STEEP
    return ", ".join([*([f"{steps} steps: not converged"] if falls else []), *above_one(unexplained)])


def _doubling(history: list[dict[str, Any]]) -> float | None:
    """Expected factor of the error by twice the training time.

    The mean of two estimates of its logarithm, weighted by their inverse variances: from the number of steps,
    and from the error in the middle of training. Where the history does not resolve the latter, only few
    steps are an answer.
    """
    last = history[-1]
    steps = last["step"]
    law = math.log((steps + 0.5 * _EARLY_STEPS) / (steps + _EARLY_STEPS))
    after = _relative_error(last)
    if after is None or after > _RESOLVED:
        return None
    known = [(r, error) for r in history if (error := _relative_error(r)) is not None]
    middle = [pair for pair in known if _MIDDLE[0] <= pair[0]["fraction"] <= _MIDDLE[1]]
    few = steps < FEWEST_STEPS
    if not middle:
        return math.exp(law) if few else None
    half, before = min(middle, key=lambda pair: abs(pair[0]["fraction"] - 0.5))
    doublings = -math.log2(half["fraction"])
    slope = _LASTING * math.log(last["unexplained"] / half["unexplained"]) / doublings
    # Both records are of the same queries: without the errors of changes, this spread is an upper bound.
    changes: list[Any] = [r.get("change_error") for r in history[history.index(half) + 1 :]]
    relative = math.hypot(after, before)
    if all(map(_number, changes)):
        # Changes of the same queries are correlated: the sum of their errors is safe.
        relative = min(relative, sum(changes) / last["unexplained"])
    spread = _LASTING * relative / doublings
    # The number of steps alone would say that longer training is useless.
    if spread > _LAW_SCATTER and not few:
        return None
    weights = _LAW_SCATTER**-2, 1.0 / (_LASTING_SCATTER**2 + spread**2)
    return math.exp((weights[0] * law + weights[1] * slope) / sum(weights))


def _relative_error(record: dict[str, Any]) -> float | None:
    """Relative standard error of the validation of a record; None where there is none."""
    value, error = record["unexplained"], record["unexplained_error"]
    return float(error / value) if _number(value) and _number(error) and value > 0 else None


def _number(x: Any) -> bool:
    return isinstance(x, int | float) and math.isfinite(x)


def _noise_share(errors: dict[str, Any], noise: float | None) -> float | None:
    """Overfitting over the error of new queries, of either split, whichever error is known best.

    A fit that overfits the noise of its training queries gains an error on other queries that equals the
    variance of what it has overfitted, and its error on the training queries falls by as much. The difference
    is twice that. Few queries cause such a difference without noise too, so the noise itself is the bound.
    """
    mse = {name: of["mse"] for name, of in errors.items() if all(map(_number, of["mse"].values()))}
    others = [mse[name] for name in ("test", "held_out_queries") if name in mse]
    new = min(others, key=lambda e: e["error"], default=None)
    training = mse.get("training")
    if noise is None or training is None or new is None or new["value"] <= SIGNIFICANT * new["error"]:
        return None
    overfit = min(0.5 * (new["value"] - training["value"]), noise)
    if overfit <= SIGNIFICANT * 0.5 * math.hypot(new["error"], training["error"]):
        return None
    return min(1.0, float(overfit / new["value"]))

"""Validation during training: the set, the error on it, the time that would halve it, and the part that is
overfitting."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from mbtf_core.data.dataset import Dataset
from mbtf_core.stats import Estimate, by_group, level_groups, unexplained_variance
from mbtf_core.units import clock
from mbtf_fit.data.loader import Partition, load_split
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.training.trainer import Trainer

# Queries of the validation subset, and the fewest test queries that are preferred over held-out queries.
_SUBSET, _FEWEST = 1 << 14, 1 << 12


def validation_set(data: Dataset, partition: Partition) -> tuple[str, ShardQueries]:
    """(name among the errors, queries) of the set on which the error is tracked.

    The test split, because it has more paths per query: four paths often do not resolve the error of glossy
    materials. The held-out queries where there is no test split, or a small one. No option is selected by it.
    """
    held_out = partition.held_out_queries
    test = load_split(data, "test") if "test" in data.splits and data.shards("test") else None
    if test is not None and len(test) >= min(len(held_out), _FEWEST):
        return "test", test
    return "held_out_queries", held_out


def validation_subset(positions: int, queries: ShardQueries, most: int = _SUBSET) -> ShardQueries:
    """At most `most` queries, evenly spread over the set; fewer for a model that reads its textures at many
    positions per query. A copy, so that the set itself can be released."""
    most = max(most // positions, most // 16)
    return queries.take(np.arange(0, len(queries), max(1, math.ceil(len(queries) / most))))


def validation_error(trainer: Trainer, queries: ShardQueries) -> Estimate:
    """Unexplained variance of queries by the current model."""
    return unexplained_variance(trainer.predict(queries), queries.value_a, queries.value_b)


def finite(number: float | None) -> float | None:
    """A number, or None where it is not finite; JSON and plots have no others."""
    return number if number is not None and math.isfinite(number) else None


def errors_by_level(trainer: Trainer, queries: ShardQueries) -> dict[str, float | None]:
    """Unexplained variance by nearest level; None where it is undefined."""
    level = level_groups(queries.sigma, trainer.model.lattice.finest)
    values = trainer.predict(queries), queries.value_a, queries.value_b
    return {str(s): finite(e.value) for s, e in by_group(unexplained_variance, level, *values).items()}


def history_record(trainer: Trainer, subset: ShardQueries) -> dict[str, Any]:
    """Progress and validation error of the current model."""
    state = trainer.progress
    found = validation_error(trainer, subset).as_dict() if len(subset) else {}
    return {
        "step": state.step,
        "seconds": round(state.seconds, 3),
        "fraction": round(trainer.fraction, 5),
        "loss": state.loss,
        "unexplained": found.get("value"),
        "unexplained_error": found.get("error"),
        "queries_per_second": round(state.step * trainer.batch / max(state.seconds, 1e-9)),
    }


# Fractions of the budget between which a record counts as the middle of training.
_MIDDLE = (0.35, 0.65)
# Standard errors that make a difference significant.
_SIGNIFICANT = 2.0
# More doublings of the time than these count as never.
_MOST_DOUBLINGS = 12.0
# Fewer steps leave the error of every model falling, whatever its last records say.
_FEWEST_STEPS = 1000
# Largest reduction of the error by the last doubling of the time that counts as none.
_FLAT = 0.1


@dataclass(frozen=True)
class MarginalCost:
    """Convergence of the error at the end of training, and how much of it is overfitting.

    Attributes
    ----------
    halving : seconds of training that would halve the error if every doubling of the time divided it as the
        last one did; infinite where that one reduced it by a tenth at most, error bar included; None where
        the history does not say. The learning rate falls towards the end, which favors the last doubling, so
        this is a lower bound
    noise_share : share of the error on queries without training that is overfitting to the noise of the
        training queries; None where it is not significant
    steps : number of training steps where they are too few to say more; else None
    """

    halving: float | None
    noise_share: float | None
    steps: int | None = None

    def as_dict(self) -> dict[str, float | int | None]:
        """Plain data for JSON, which has no infinite numbers."""
        finite = self.halving is not None and math.isfinite(self.halving)
        return {
            "halving": self.halving if finite else None,
            "noise_share": self.noise_share,
            "steps": self.steps,
        }

    def describe(self) -> str:
        """One line, or two, without another number for the error."""
        if self.steps is not None:
            return f"{self.steps} steps are few: train longer (--time)"
        lines = []
        if self.halving == math.inf:
            lines.append("longer training alone would hardly reduce the error")
        elif self.halving is not None:
            lines.append(f"halving the error takes about {clock(self.halving)} more of training, or longer")
        if self.noise_share is not None:
            lines.append(
                f"overfitting to noise causes {self.noise_share:.0%} of the error of new queries: use more "
                "queries, or more paths per query"
            )
        return "\n".join(lines)


def marginal_cost_of(
    history: list[dict[str, Any]], errors: dict[str, Any], noise: float | None = None
) -> MarginalCost | None:
    """Marginal cost of a finished fit, from the records of its history, its errors by split, and the variance
    of the noise of training values in 1/sr² (None: unknown); None where nothing is resolved."""
    steps = history[-1].get("step") if history else None
    if steps is not None and steps < _FEWEST_STEPS:
        return MarginalCost(None, None, steps)
    share, halving = _noise_share(errors, noise), _halving(history)
    return None if share is None and halving is None else MarginalCost(halving, share)


def _halving(history: list[dict[str, Any]]) -> float | None:
    known = [r for r in history if _number(r.get("unexplained")) and _number(r.get("unexplained_error"))]
    middle = [r for r in known if _MIDDLE[0] <= r.get("fraction", -1.0) <= _MIDDLE[1]]
    if not middle or known[-1].get("fraction", 0.0) < 1.0:
        return None
    last, half = known[-1], min(middle, key=lambda r: abs(r["fraction"] - 0.5))
    before, after = half["unexplained"], last["unexplained"]
    spread = math.hypot(half["unexplained_error"], last["unexplained_error"])
    # Both records are of the same queries, so this test is conservative.
    if before - after <= _SIGNIFICANT * spread:
        flat = before - after + _SIGNIFICANT * spread <= _FLAT * before
        return math.inf if flat else None
    if after <= 0:
        return None
    doublings = math.log(2.0) / math.log(before / after) * math.log2(last["seconds"] / half["seconds"])
    never = doublings >= _MOST_DOUBLINGS
    return math.inf if never else float(last["seconds"] * (2.0**doublings - 1.0))


def _number(x: Any) -> bool:
    return isinstance(x, int | float) and math.isfinite(x)


def _noise_share(errors: dict[str, Any], noise: float | None) -> float | None:
    """Overfitting over the error of new queries: test or held-out queries, whichever error is known best.

    A fit that overfits the noise of its training queries gains an error on other queries that equals the
    variance of what it has overfitted, and its error on the training queries falls by as much. The difference
    is twice that. Few queries cause such a difference without noise too, so the noise itself is the bound.
    """
    mse = {name: of["mse"] for name, of in errors.items() if all(map(_number, of["mse"].values()))}
    others = [mse[name] for name in ("test", "held_out_queries") if name in mse]
    new = min(others, key=lambda e: e["error"], default=None)
    training = mse.get("training")
    if noise is None or training is None or new is None or new["value"] <= _SIGNIFICANT * new["error"]:
        return None
    overfit = min(0.5 * (new["value"] - training["value"]), noise)
    if overfit <= _SIGNIFICANT * 0.5 * math.hypot(new["error"], training["error"]):
        return None
    return min(1.0, float(overfit / new["value"]))

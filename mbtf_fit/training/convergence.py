"""Marginal cost of a fit's error: the training time that would halve it, and the part that is overfitting."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from mbtf_core.units import clock

# Fractions of the budget between which a record counts as the middle of training.
_MIDDLE = (0.35, 0.65)
# Standard errors that make a difference significant.
_SIGNIFICANT = 2.0
# More doublings of the time than these count as never.
_MOST_DOUBLINGS = 12.0


@dataclass(frozen=True)
class MarginalCost:
    """Convergence of the error at the end of training, and how much of it is overfitting.

    Attributes
    ----------
    halving : seconds of training that would halve the error if every doubling of the time divided it as the
        last one did; infinite where that one was not significant, None where the history does not say. The
        learning rate falls towards the end, which favors the last doubling, so this is a lower bound
    noise_share : share of the error on queries without training that is overfitting to the noise of the
        training queries; None where it is not significant
    """

    halving: float | None
    noise_share: float | None

    def as_dict(self) -> dict[str, float | None]:
        """Plain data for JSON, which has no infinite numbers."""
        finite = self.halving is not None and math.isfinite(self.halving)
        return {"halving": self.halving if finite else None, "noise_share": self.noise_share}

    def describe(self) -> str:
        """One line, or two, without another number for the error."""
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
    if after <= 0 or before - after <= _SIGNIFICANT * spread:
        return math.inf
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

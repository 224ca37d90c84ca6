"""What reduces the error of a finished fit most."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from mbtf_core.data.dataset import Dataset
from mbtf_core.stats import SIGNIFICANT
from mbtf_fit.formatting import headline, unreliable
from mbtf_fit.training.endings import reached
from mbtf_fit.training.fit_folder import training_digest
from mbtf_fit.training.validation import FEWEST_STEPS, FLAT, MarginalCost, marginal_cost_of

if TYPE_CHECKING:
    from mbtf_core.data.folder import DataFolder
    from mbtf_fit.material.material import Material

# Below so many steps, the error itself says little; few steps with a larger error are not enough.
_UNTRAINED, _HARDLY = 100, 0.5
# Factor of the error by which twice the training pays more than better data after few steps.
_PAYS = 0.9
# Relative standard error of the test error from which more test queries come first.
_UNCERTAIN = 0.25
# Of an error that is all due to noise, twice the queries remove this share.
_LIMITED = 0.3
_NO_GAIN = "neither twice the training nor twice the queries would reduce the error by 5%"


@dataclass(frozen=True)
class NextStep:
    """The most useful change after a fit.

    Attributes
    ----------
    kind : what to take more of: test queries, training time, training queries; or nothing
    reason : one sentence
    """

    kind: Literal["test", "time", "queries", "none"]
    reason: str


def next_step(cost: MarginalCost, errors: Mapping[str, Any]) -> NextStep:
    """What the evidence says pays most: the marginal cost of a fit, and its errors by split."""
    split = errors[headline(errors)]
    own, spread = (errors.get("training", split)["unexplained"][key] for key in ("value", "error"))
    value, error = split["unexplained"]["value"], split["unexplained"]["error"]
    # A fit that kept an earlier state has trained long enough. Others, after few steps, are limited by noise
    # only where it leaves nothing to longer training.
    few = cost.few and cost.kept_step is None
    learns = few and (cost.doubling is None or cost.doubling < _PAYS)
    overfit, limit = (0.0, 0.0) if learns else (0.5 * (cost.noise_share or 0.0), _LIMITED * cost.noise_limit)
    data = 1.0 - max(overfit, limit)
    most = _HARDLY if data >= FLAT else 1.0
    if few and (value is None or value >= most or cost.steps < _UNTRAINED):
        factor = 2 ** math.ceil(math.log2(FEWEST_STEPS / cost.steps))
        return NextStep("time", f"{cost.steps} steps are few: train {factor} times as long")
    short = ""
    if cost.kept_step is not None:
        short = f"the fit overfits noise after {cost.kept_step} steps"
    elif data < FLAT and limit > overfit:
        known = f"{cost.noise:.0%} of the variance of values, {cost.density:.3g} queries per texel"
        short = f"noise of the training queries limits the fit ({known})"
    elif data < FLAT:
        short = "the fit overfits noise"
    elif None not in (value, error, own, spread):
        is_less = value - own > max(0.5 * value, SIGNIFICANT * math.hypot(error, spread))
        short = "the error of training queries is less than half as large" if is_less else ""
    if (
        value is None
        or error is None
        or error > _UNCERTAIN * abs(value)
        or (unreliable(split) and not learns)
    ):
        better = "four times as many measure it better"
        if not short:
            return NextStep("test", f"few test queries decide the error; {better}")
        reason = f"{short}; twice the queries reduce the error; few test queries decide it: {better}"
        return NextStep("queries", reason)
    if value >= 1.0 and own is not None and own < 1.0:
        return NextStep("queries", "the training queries are too few or too noisy: take twice as many")
    if cost.kept_step is not None:
        if 1.0 - overfit >= FLAT:
            return NextStep("none", f"{short}; {_NO_GAIN}")
        return NextStep("queries", f"{short}; {_at_best(1.0 - overfit)}")
    time = cost.doubling
    if data < min(FLAT, 1.0 if time is None else time):
        return NextStep("queries", f"{short}; {_at_best(data)}")
    if time is None:
        reason = f"{cost.steps} steps are few" if few else "it is unknown what longer training gains"
        return NextStep("time", f"{reason}; try twice the training")
    if time < FLAT or few:
        return NextStep("time", f"expect about {time:.2g} of this error after twice the training")
    return NextStep("none", _NO_GAIN)


def _at_best(factor: float) -> str:
    # Of cloth by few noisy queries, twice as many have left 0.69 to 0.99 of the error.
    return f"expect {factor:.2g} to 1 of this error with twice the queries"


def suggest(material: Material, history: list[dict[str, Any]], errors: dict[str, Any]) -> NextStep | None:
    """What reduces the error of a fit most, from the records of its validations and its errors by split. None
    where it is unfinished, has reached the error that it was asked for, or shares a network."""
    config, training = material.config, material.description["training"]
    cost = marginal_cost_of(history, errors, training)
    if cost is None or not errors or config.training.shared_decoder or reached(config, history):
        return None
    return next_step(cost, errors)


def advise(
    material: Material,
    shards: DataFolder,
    history: list[dict[str, Any]],
    errors: dict[str, Any],
) -> str | None:
    """One line on what reduces the error of a fit most, by its errors on a data set; None where
    :func:`suggest` has none."""
    step = suggest(material, history, errors)
    if step is None:
        return None
    if material.description["training"]["shards_sha256"] != training_digest(Dataset.open(shards)):
        return "the fit had other training data; evaluate it on them for advice"
    return step.reason

"""The state of a fit with the smallest validation error, and the bound of its values.

A fit that overfits is best before its end. Its last state is replaced only where an earlier one is better
beyond noise and by a twentieth, by the difference of both errors on the same validation queries, whose noise
mostly cancels. So the choice among states hardly biases the errors that are reported, and other fits are as
they were. A last state that is worse than the mean value is replaced by an earlier one that is better: a
single false glint makes a difference of one standard error, however bright it is.

Rare highlights are learned from single queries, and recur as false glints at directions between. Validation
finds out what is lost by a lower bound of the values, and what by the glints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.stats import Estimate, mse_difference, noise_free_mse, signal_variance
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.objective.noise import LEAST_BOUND
from mbtf_fit.training.trainer import Trainer, TrainingProgress

# Standard errors that make a difference significant: the best of many states is compared. Its least share of
# the best error: paired errors resolve differences that do not matter.
_SIGNIFICANT, _LEAST = 3.0, 0.05
# Bounds of the values that are compared.
_TRIED = 4
# Steps of the first state that may be kept, and how many there are until twice the steps.
_FIRST, _PER_OCTAVE = 32, 2


def is_candidate(step: int) -> bool:
    """Whether the state after so many steps may be kept; these follow from their number alone, so that the
    speed of the machine has no influence."""
    if step < _FIRST:
        return False
    k = round(_PER_OCTAVE * math.log2(step / _FIRST))
    return step == round(_FIRST * 2.0 ** (k / _PER_OCTAVE))


@dataclass(frozen=True)
class BestState:
    """State of a training loop at a validation.

    Attributes
    ----------
    tensors : parameters by name, as :func:`~mbtf_fit.training.loop.weights_of`
    progress : steps done
    predictions : values (n, 3) of the validation queries of each material
    """

    tensors: dict[str, Tensor]
    progress: TrainingProgress
    predictions: list[NDArray[np.float32]]


def excess_error(
    predictions: Sequence[NDArray[np.float32]],
    others: Sequence[NDArray[np.float32]],
    subsets: Sequence[ShardQueries],
) -> Estimate:
    """Mean squared error of predictions (n, 3) minus that of others, free of noise and compared query by
    query, over the variance of the values; summed over materials with queries `subsets`."""
    found = [
        mse_difference(prediction, other, *queries.halves).scaled(1.0 / _unit(queries))
        for prediction, other, queries in zip(predictions, others, subsets, strict=True)
    ]
    error = math.hypot(*(e.error for e in found))
    return Estimate(sum(e.value for e in found), error, sum(e.n for e in found))


def overfits(
    predictions: Sequence[NDArray[np.float32]],
    best: Sequence[NDArray[np.float32]],
    subsets: Sequence[ShardQueries],
) -> bool:
    """Whether predictions are worse than the best ones, beyond noise and by a twentieth of the error, or
    worse than the mean value, which the best ones are not."""
    excess = excess_error(predictions, best, subsets)
    least = sum(
        noise_free_mse(prediction, *queries.halves).value / _unit(queries)
        for prediction, queries in zip(best, subsets, strict=True)
    )
    significant = excess.value > max(_SIGNIFICANT * excess.error, _LEAST * least)
    return significant or least < len(subsets) <= least + excess.value


def lower_bound(trainer: Trainer, queries: ShardQueries, prediction: NDArray[np.float32]) -> None:
    """Divide the bound of learned values by the least power of 4 whose validation error is within a twentieth
    of the smallest. The bound stays at least :data:`~mbtf_fit.objective.noise.LEAST_BOUND`.

    There is no test of significance: a single glint makes a difference of one standard error, however bright
    it is, and bounds above the values of all validation queries make no difference.

    Parameters
    ----------
    trainer : of the material
    queries : for validation
    prediction : their values (n, 3) at the present bound
    """
    bounds = [trainer.model.number(name) for name in trainer.model.bounds]
    first = float(bounds[0]) if bounds and len(queries) else 0.0
    tried = [most for k in range(_TRIED) if (most := first / 4.0**k) >= LEAST_BOUND]
    if len(tried) < 2:
        return
    errors = [noise_free_mse(prediction, *queries.halves).value]
    for most in tried[1:]:
        for bound in bounds:
            bound.fill_(most)
        errors.append(noise_free_mse(trainer.predict(queries), *queries.halves).value)
    good = min(errors) + _LEAST * abs(min(errors))
    chosen = next(most for most, error in zip(tried, errors, strict=True) if error <= good)
    for bound in bounds:
        bound.fill_(chosen)


def _unit(queries: ShardQueries) -> float:
    variance = signal_variance(*queries.halves).value
    return variance if variance > 0 else 1.0

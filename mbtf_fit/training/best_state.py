"""The state of a fit with the smallest validation error.

A fit that overfits is best before its end. Its last state is replaced only where an earlier one is better
beyond noise, by the difference of both errors on the same validation queries, whose noise mostly cancels. So
the choice among states hardly biases the errors that are reported, and other fits are as they were.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.stats import Estimate, mse_difference, signal_variance
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.training.trainer import TrainingProgress

# Standard errors that make a difference significant: the best of many states is compared.
SIGNIFICANT = 3.0


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
    found = []
    for prediction, other, queries in zip(predictions, others, subsets, strict=True):
        variance = signal_variance(*queries.halves).value
        unit = variance if variance > 0 else 1.0
        found.append(mse_difference(prediction, other, *queries.halves).scaled(1.0 / unit))
    error = math.hypot(*(e.error for e in found))
    return Estimate(sum(e.value for e in found), error, sum(e.n for e in found))

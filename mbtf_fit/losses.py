"""Training losses of linear values. Both are unbiased by noise in the data: their minimum is the expectation.

The published code of NeuMIP compares logarithms and adds an absolute error; with a few paths per query both
pull dark, towards the median of the noisy values.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

Loss = Callable[[Tensor, Tensor], Tensor]


def squared_error(variance: float) -> Loss:
    """Mean of ``(p-t)²`` over the variance of the data: what the reported error measures.

    On glossy materials it is the error of a few highlights.
    """

    def loss(prediction: Tensor, value: Tensor) -> Tensor:
        return (prediction - value).square().mean() / variance

    return loss


def relative_error(floor: float) -> Loss:
    """Mean of ``(p-t)² / (p² + floor²)``, the denominator held constant under differentiation.

    Because the weight depends on the prediction and not on the noisy value, the gradient vanishes on average
    where the prediction is the expectation: weighting leaves no bias. `floor` is a value in 1/sr, the mean
    of the data as a rule; below it errors count absolutely. (Noise2Noise uses the same form for HDR images:
    Lehtinen et al., ICML 2018.)
    """

    def loss(prediction: Tensor, value: Tensor) -> Tensor:
        weight = 1.0 / (prediction.detach().square() + floor * floor)
        return (weight * (prediction - value).square()).mean()

    return loss

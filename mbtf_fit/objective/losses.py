"""What training minimizes: a weighted sum of terms, unbiased by noise in the data, and robust.

A term compares ``f(p)`` with ``f(t)``: p the prediction, t the noisy value of a query, both in units of s,
the typical value of the data; f is one of a few curves. Where f is not straight, ``E f(t)`` is not ``f(E
t)``, and the minimum is off by about ``½ f''·variance / f'``; absolute differences pull towards the median.
Three ways to treat that, ``correction``:

``none``
    as published: f(t) itself.
``second-order``
    ``f(t) - ½ f''(p)·variance(p)`` with the variance model pooled over queries (:mod:`mbtf_fit.objective.noise`): right
    as long as the noise is small against the value.
``linear`` (default)
    f along its tangent at the prediction, ``f(p) + f'(p)(t - p)``: linear in t, so that the noise averages
    out whatever its size. Squared terms become ``f'(p)² (p-t)²``, weighted by the prediction alone; absolute
    ones, which have no such form, become the parabola that they are on average where noise hides the error,
    ``f'(p)² (p-t)² / 2√(f'(p)² variance(p) + δ²)``.

In all of it p stands still under differentiation, except in f(p) itself.

A single value far from everything else (a firefly, a damaged pixel) must not decide. Beyond ``robust`` times
what a query may well be off by, ``√(s² + noise variance(p))``, its influence grows no further: Huber's rule
(Annals of Mathematical Statistics 35, 1964), applied to ``t - p`` before anything else. Data are never
clamped: where they keep saying the same, the prediction moves on until they are within the bound.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mbtf_fit.config import Correction, LossKind, TrainingSection
from mbtf_fit.objective.noise import NoiseModel

if TYPE_CHECKING:
    from mbtf_fit.data.images import Crops
    from mbtf_fit.data.loader import TrainingQueries

# Absolute terms are parabolas below this, in units of f.
_DELTA = 0.1
# Added under the fourth root, in units of s: its slope is infinite at 0.
_ROOT_FLOOR = 1e-2
# Below this, in units of s, curves go on along their tangent: predictions and noisy values may be negative.
_LOG_START = -0.5


class Curve(ABC):
    """f of values in units of s, defined for all real numbers, rising."""

    @abstractmethod
    def value(self, x: Tensor) -> Tensor:
        """f(x)"""

    @abstractmethod
    def slope(self, x: Tensor) -> Tensor:
        """f'(x)"""

    @abstractmethod
    def curvature(self, x: Tensor) -> Tensor:
        """f''(x)"""


class Straight(Curve):
    """x itself."""

    def value(self, x: Tensor) -> Tensor:
        return x

    def slope(self, x: Tensor) -> Tensor:
        return torch.ones_like(x)

    def curvature(self, x: Tensor) -> Tensor:
        return torch.zeros_like(x)


class Log(Curve):
    """log(1 + x)."""

    def value(self, x: Tensor) -> Tensor:
        y = x.clamp_min(_LOG_START)
        return torch.log1p(y) + (x - y) / (1 + _LOG_START)

    def slope(self, x: Tensor) -> Tensor:
        return 1 / (1 + x.clamp_min(_LOG_START))

    def curvature(self, x: Tensor) -> Tensor:
        return torch.where(x > _LOG_START, -self.slope(x).square(), 0.0)


class FourthRoot(Curve):
    """(x + 0.01)^¼."""

    def value(self, x: Tensor) -> Tensor:
        y = x.clamp_min(0)
        return (y + _ROOT_FLOOR) ** 0.25 + (x - y) * self.slope(y)

    def slope(self, x: Tensor) -> Tensor:
        return 0.25 * (x.clamp_min(0) + _ROOT_FLOOR) ** -0.75

    def curvature(self, x: Tensor) -> Tensor:
        return torch.where(x > 0, -0.1875 * (x.clamp_min(0) + _ROOT_FLOOR) ** -1.75, 0.0)


# Of the error f(p) - f(t) and, where the correction needs it, the variance of f(t).
Measure = Callable[[Tensor, Tensor | None], Tensor]


def squared(error: Tensor, noise: Tensor | None) -> Tensor:
    """Mean square."""
    return error.square().mean()


def absolute(error: Tensor, noise: Tensor | None) -> Tensor:
    """Mean absolute value, or the parabola that stands for it under noise."""
    if noise is None:
        return error.abs().mean()
    return (error.square() / (noise + _DELTA**2).sqrt()).mean() / 2


def absolute_gradient(error: Tensor, noise: Tensor | None) -> Tensor:
    """Mean :func:`absolute` of the differences between neighbors along rows and columns of buffers (items,
    rows, columns, 3)."""
    # A single row or column has no neighbors along it: nothing to compare there, not even a mean.
    total = 0.0 * error.sum()
    for axis in (1, 2):
        n = error.shape[axis] - 1
        if n == 0:
            continue
        both = None if noise is None else noise.narrow(axis, 0, n) + noise.narrow(axis, 1, n)
        total = total + absolute(error.narrow(axis, 1, n) - error.narrow(axis, 0, n), both)
    return total / 2


@dataclass(frozen=True)
class CurveTerm:
    """One term: a curve, and the measure of differences along it."""

    curve: Curve
    measure: Measure

    def __call__(
        self, p: Tensor, still: Tensor, t: Tensor, variance: Tensor | None, correction: Correction
    ) -> Tensor:
        """Mean of the term over arrays (n, 3), or (items, rows, columns, 3), in units of s.

        Parameters
        ----------
        p : prediction; still : the same, held still under differentiation
        t : value
        variance : of t; None without correction
        """
        if variance is None:
            return self.measure(self.curve.value(p) - self.curve.value(t), None)
        if correction == "second-order":
            target = self.curve.value(t) - 0.5 * self.curve.curvature(still) * variance
            return self.measure(self.curve.value(p) - target, None)
        slope = self.curve.slope(still)
        target = self.curve.value(still) + slope * (t - still)
        return self.measure(self.curve.value(p) - target, slope.square() * variance)


def relative(p: Tensor, still: Tensor, t: Tensor, variance: Tensor | None, correction: Correction) -> Tensor:
    """``(p-t)² / (p² + s²)``, the denominator held still: a weight made of the prediction leaves no bias.

    Lehtinen et al. (Noise2Noise, ICML 2018) use this form for HDR images.
    """
    return ((p - t).square() / (still.square() + 1)).mean()


_TERMS: dict[LossKind, Callable[[Tensor, Tensor, Tensor, Tensor | None, Correction], Tensor]] = {
    "relative": relative,
    "squared": CurveTerm(Straight(), squared),
    "linear": CurveTerm(Straight(), absolute),
    "log": CurveTerm(Log(), squared),
    "fourth-root": CurveTerm(FourthRoot(), absolute),
    "gradient": CurveTerm(FourthRoot(), absolute_gradient),
}
# Terms that are linear in the value as they stand.
_STRAIGHT: tuple[LossKind, ...] = ("relative", "squared")


@dataclass(frozen=True)
class Quadratic:
    """A loss that is ``(relative / (p² + s²) + squared / s²)·d²``, ``d = p - t`` held within
    ``±√(b₀ + b₁|p| + b₂p²)``, all but d held still under differentiation.

    Attributes
    ----------
    relative, squared : weights; scale : s in 1/sr; bound : b, or None for none
    """

    relative: float
    squared: float
    scale: float
    bound: tuple[float, float, float] | None


class Objective:
    """The sum of a configuration's terms, for data of one noise model.

    Parameters
    ----------
    training : terms, their weights, correction, robust bound
    noise : model of the data's noise; its scale s, the typical value of the data, is the unit of all terms
    """

    def __init__(self, training: TrainingSection, noise: NoiseModel) -> None:
        self._terms = [(term.weight, _TERMS[term.kind]) for term in training.losses]
        self._correction = training.correction
        self._robust = training.robust
        self._noise = noise
        # Black data have no unit of their own.
        self._unit = noise.scale if noise.scale > 0 else 1.0
        straight = all(term.kind in _STRAIGHT for term in training.losses)
        self._needs_variance = training.correction != "none" and not straight

    def quadratic(self) -> Quadratic | None:
        """The same loss in the form that the compiled kernel knows; None where it has none."""
        weights = {term: sum(w for w, t in self._terms if t is term) for _, term in self._terms}
        relative_weight, squared_weight = (weights.pop(_TERMS[kind], 0.0) for kind in _STRAIGHT)
        if weights:
            return None
        bound = None
        if self._robust is not None:
            c0, c1, c2 = (self._robust**2 * float(c) for c in self._noise.overall)
            scale = self._noise.scale
            bound = ((self._robust**2 + c0) * scale**2, c1 * scale, c2)
        return Quadratic(relative_weight, squared_weight, self._unit, bound)

    def bound(self, prediction: Tensor) -> Tensor | None:
        """Largest errors of predictions (n, 3) that pull in proportion; None where all do."""
        return None if self._robust is None else self._robust * self._noise.spread(prediction)

    def __call__(self, prediction: Tensor, queries: TrainingQueries | Crops) -> Tensor:
        """Weighted sum of the terms' means for predictions (n, 3), or (items, rows, columns, 3)."""
        still, value = prediction.detach(), queries.value
        bound = self.bound(still)
        if bound is not None:
            value = still + (value - still).clamp_(-bound, bound)
        variance = None
        if self._needs_variance:
            variance = self._noise.variance(still, queries.sigma, queries.omega_i, queries.omega_o)
            variance = variance / self._unit**2
        p, still, t = prediction / self._unit, still / self._unit, value / self._unit
        total = prediction.new_zeros(())
        for weight, term in self._terms:
            total = total + weight * term(p, still, t, variance, self._correction)
        return total

"""Losses: a weighted sum of robust terms without bias from the noise of the data.

A term compares ``f(p)`` with ``f(t)``: p is the prediction, t the noisy value of a query, both in units of s,
the typical value of the data, and f is a curve. Where f is not linear, ``E f(t)`` differs from ``f(E t)``,
and the minimum is biased by about ``½ f''·variance / f'``. Absolute differences are biased towards the
median.
``correction`` selects one of two treatments:

``none``
    as published: f(t) itself.
``linear`` (default)
    the tangent of f at the prediction, ``f(p) + f'(p)(t - p)``: linear in t, so that noise of any size
    averages out. Squared terms become ``f'(p)² (p-t)²``, weighted by the prediction alone. Absolute terms
    become the parabola that they are on average where noise dominates the error,
    ``f'(p)² (p-t)² / 2√(f'(p)² variance(p) + δ²)``, with the variance pooled over queries
    (:mod:`mbtf_fit.objective.noise`).

In both, p is detached (constant under differentiation), except in f(p) itself.

Outliers (fireflies, corrupt pixels) have a bounded influence: the Huber rule (Annals of Mathematical
Statistics 35, 1964) clamps ``t - p`` to ``huber_delta`` times ``√(s² + noise variance(p))``. The data
themselves are not clamped: where they agree, the prediction moves until they are within the bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.sections import LossKind, TrainingSection

if TYPE_CHECKING:
    from mbtf_fit.data.layouts import Patches
    from mbtf_fit.data.queries import TrainingQueries

# Absolute terms are parabolas below this, in units of f.
_DELTA = 0.1
# Added under the fourth root, in units of s: its slope is infinite at 0.
_ROOT_FLOOR = 1e-2
# Below this, in units of s, curves continue along their tangent: predictions and values may be negative.
_LOG_START = -0.5


class LossCurve:
    """An increasing function f of values in units of s, defined for all real numbers: here f(x) = x."""

    def value(self, x: Tensor) -> Tensor:
        """f(x)"""
        return x

    def slope(self, x: Tensor) -> Tensor:
        """f'(x)"""
        return torch.ones_like(x)


class Log(LossCurve):
    """log(1 + x)."""

    def value(self, x: Tensor) -> Tensor:
        y = x.clamp_min(_LOG_START)
        return torch.log1p(y) + (x - y) / (1 + _LOG_START)

    def slope(self, x: Tensor) -> Tensor:
        return 1 / (1 + x.clamp_min(_LOG_START))


class FourthRoot(LossCurve):
    """(x + 0.01)^¼."""

    def value(self, x: Tensor) -> Tensor:
        y = x.clamp_min(0)
        return (y + _ROOT_FLOOR).sqrt().sqrt() + (x - y) * self.slope(y)

    def slope(self, x: Tensor) -> Tensor:
        # Two square roots are several times faster than a power.
        z = x.clamp_min(0) + _ROOT_FLOOR
        return 0.25 * z.sqrt().sqrt() / z


# Of the error f(p) - f(t) and, where the correction needs it, the variance of f(t).
Measure = Callable[[Tensor, Tensor | None], Tensor]


def squared(error: Tensor, noise: Tensor | None) -> Tensor:
    """Mean square."""
    return error.square().mean()


def absolute(error: Tensor, noise: Tensor | None) -> Tensor:
    """Mean absolute value, or its parabola under noise."""
    if noise is None:
        return error.abs().mean()
    return (error.square() / (noise + _DELTA**2).sqrt()).mean() / 2


def absolute_gradient(error: Tensor, noise: Tensor | None) -> Tensor:
    """Mean :func:`absolute` of the differences between neighbors along rows and columns of patches (items,
    rows, columns, 3)."""
    total = 0.0 * error.sum()
    for axis in (1, 2):
        n = error.shape[axis] - 1
        if n == 0:  # a single row or column has no neighbors
            continue
        both = None if noise is None else noise.narrow(axis, 0, n) + noise.narrow(axis, 1, n)
        total = total + absolute(error.narrow(axis, 1, n) - error.narrow(axis, 0, n), both)
    return total / 2


@dataclass(frozen=True)
class CurveTerm:
    """One term: a curve, and the measure of differences along it."""

    curve: LossCurve
    measure: Measure

    def __call__(self, p: Tensor, detached: Tensor, t: Tensor, variance: Tensor | None) -> Tensor:
        """Mean of the term over arrays (n, 3), or (items, rows, columns, 3), in units of s: prediction p, the
        same constant under differentiation, value t, and its variance (None without correction)."""
        if variance is None:
            return self.measure(self.curve.value(p) - self.curve.value(t), None)
        slope = self.curve.slope(detached)
        target = self.curve.value(detached) + slope * (t - detached)
        return self.measure(self.curve.value(p) - target, slope.square() * variance)


def relative(p: Tensor, detached: Tensor, t: Tensor, variance: Tensor | None) -> Tensor:
    """``(p-t)² / (p² + s²)`` with a detached denominator, so that the weight causes no bias (for HDR images:
    Lehtinen et al., Noise2Noise, ICML 2018)."""
    return ((p - t).square() / (detached.square() + 1)).mean()


def chroma(p: Tensor, detached: Tensor, t: Tensor, variance: Tensor | None) -> Tensor:
    """Mean square of how far the relative errors ``e = (p-t) / √(p² + s²)`` of the channels deviate from
    their mean: what changes the color of a value, not its brightness."""
    error = (p - t) / (detached.square() + 1).sqrt()
    return (error - error.mean(-1, keepdim=True)).square().mean()


# Of prediction, detached prediction, value, and its variance.
Term = Callable[[Tensor, Tensor, Tensor, Tensor | None], Tensor]
_TERMS: dict[LossKind, Term] = {
    "relative": relative,
    "squared": CurveTerm(LossCurve(), squared),
    "chroma": chroma,
    "linear": CurveTerm(LossCurve(), absolute),
    "log": CurveTerm(Log(), squared),
    "fourth-root": CurveTerm(FourthRoot(), absolute),
    "gradient": CurveTerm(FourthRoot(), absolute_gradient),
}
# Terms whose gradient is linear in the value.
_QUADRATIC: tuple[LossKind, ...] = ("relative", "squared", "chroma")


@dataclass(frozen=True)
class Quadratic:
    """The loss ``relative·e² + squared·d² / s² + chroma·(e - ē)²`` with ``d = p - t``, which is clamped to
    ``±√(b₀ + b₁|p| + b₂p²)``, and ``e = d / √(p² + s²)``; ē is the mean over the channels, and all but d is
    detached.

    Attributes
    ----------
    relative, squared, chroma : weights; scale : s in 1/sr; bound : b, or None for none
    """

    relative: float
    squared: float
    chroma: float
    scale: float
    bound: tuple[float, float, float] | None


class Objective:
    """Sum of a configuration's terms, for data of one noise model.

    A term counts once a fraction of the training is spent, its ``start``.

    Parameters
    ----------
    training : terms, their weights, correction and Huber threshold
    noise : model of the data's noise; its scale, the typical value of the data in 1/sr, is the unit of all
        terms

    Attributes
    ----------
    fraction : fraction of the training that is spent; by default 1, so that all terms count
    """

    def __init__(self, training: TrainingSection, noise: NoiseModel) -> None:
        self._all_terms = training.losses
        self.fraction = 1.0
        self._huber_delta = training.huber_delta
        self._noise = noise
        # Black data have no scale.
        self._unit = noise.scale if noise.scale > 0 else 1.0
        quadratic = all(term.kind in _QUADRATIC for term in training.losses)
        self._needs_variance = training.correction != "none" and not quadratic

    @property
    def _terms(self) -> list[tuple[float, Term]]:
        """Weight and function of the terms that count."""
        counting = (term for term in self._all_terms if term.start <= self.fraction)
        return [(term.weight, _TERMS[term.kind]) for term in counting]

    def quadratic(self) -> Quadratic | None:
        """The same loss for the compiled kernel; None if it has another form."""
        weights = {term: sum(w for w, t in self._terms if t is term) for _, term in self._terms}
        relative_weight, squared_weight, chroma_weight = (
            weights.pop(_TERMS[kind], 0.0) for kind in _QUADRATIC
        )
        if weights:
            return None
        bound = None
        if self._huber_delta is not None:
            c0, c1, c2 = (self._huber_delta**2 * float(c) for c in self._noise.overall)
            scale = self._noise.scale
            bound = ((self._huber_delta**2 + c0) * scale**2, c1 * scale, c2)
        return Quadratic(relative_weight, squared_weight, chroma_weight, self._unit, bound)

    def bound(self, prediction: Tensor) -> Tensor | None:
        """Huber bound (n, 3) of the errors of predictions (n, 3); None without one."""
        return None if self._huber_delta is None else self._huber_delta * self._noise.spread(prediction)

    def __call__(self, prediction: Tensor, queries: TrainingQueries | Patches) -> Tensor:
        """Weighted sum of the terms' means for predictions (n, 3), or (items, rows, columns, 3) of
        patches."""
        detached, value = prediction.detach(), queries.value
        bound = self.bound(detached)
        if bound is not None:
            value = detached + (value - detached).clamp_(-bound, bound)
        variance = None
        if self._needs_variance:
            variance = self._noise.variance(detached, queries.sigma, queries.omega_i, queries.omega_o)
            variance = variance / self._unit**2
        p, detached, t = prediction / self._unit, detached / self._unit, value / self._unit
        total = prediction.new_zeros(())
        for weight, term in self._terms:
            total = total + weight * term(p, detached, t, variance)
        return total

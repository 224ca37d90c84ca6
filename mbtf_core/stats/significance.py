"""Tests of estimates against known values and against each other, and corrections for many of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.stats.estimate import Estimate

Alternative = Literal["two-sided", "greater", "less"]

# Below this many independent units a normal approximation of the error bar is not trusted.
Z_MINIMUM = 1000


@dataclass(frozen=True)
class Outcome:
    """Result of one test.

    Attributes
    ----------
    difference : Estimate
        Quantity that is tested against zero.
    statistic : float
        Difference over its error.
    p_value : float
        Probability of a statistic at least as extreme under the null hypothesis.
    """

    difference: Estimate
    statistic: float
    p_value: float

    def __str__(self) -> str:
        return f"difference {self.difference}, {self.statistic:+.2f} standard errors, p = {self.p_value:.3g}"


def _difference(x: Estimate, y: Estimate | float) -> Estimate:
    """x - y for independent x and y, with the degrees of freedom of Welch and Satterthwaite."""
    if not isinstance(y, Estimate):
        return Estimate(x.value - float(y), x.error, x.n, x.dof)
    error = math.hypot(x.error, y.error)
    if error == 0.0 or not math.isfinite(error):
        return Estimate(x.value - y.value, error, min(x.n, y.n), min(x.degrees, y.degrees))
    shares = (x.error / error) ** 4 / x.degrees + (y.error / error) ** 4 / y.degrees
    return Estimate(x.value - y.value, error, min(x.n, y.n), 1.0 / shares)


def _statistic(difference: Estimate) -> float:
    if math.isnan(difference.value) or math.isnan(difference.error):
        raise ValueError(f"an estimate of {difference} cannot be tested")
    if difference.value == 0.0:
        return 0.0
    return (
        difference.value / difference.error if difference.error else math.copysign(math.inf, difference.value)
    )


def _tail(statistic: float, dof: float | None, alternative: Alternative) -> float:
    """p-value of a standard normal (dof None) or Student statistic."""
    from scipy.special import ndtr, stdtr

    def above(t: float) -> float:
        return float(ndtr(-t) if dof is None else stdtr(dof, -t))

    if alternative == "two-sided":
        return min(1.0, 2.0 * above(abs(statistic)))
    return above(statistic if alternative == "greater" else -statistic)


def z_test(
    x: Estimate,
    y: Estimate | float = 0.0,
    alternative: Alternative = "two-sided",
    *,
    minimum: int = Z_MINIMUM,
) -> Outcome:
    """Does x differ from y, a known value or an independent estimate? Normal statistic.

    The error bar is treated as exact, which is valid for aggregates only: an error from one pair of halves
    has one degree of freedom, and a z-test on it rejects 30 % of correct queries at 2σ instead of 5 %. Use
    :func:`t_test` for fewer than `minimum` units.

    Parameters
    ----------
    x : Estimate
    y : Estimate or float
        A known value or an independent estimate.
    alternative : {"two-sided", "greater", "less"}
    minimum : int
        Smallest number of units.

    Returns
    -------
    Outcome

    Raises
    ------
    ValueError
        An estimate has fewer than `minimum` units.
    """
    for estimate in (x, y):
        if isinstance(estimate, Estimate) and estimate.n < minimum:
            raise ValueError(
                f"a z-test needs {minimum} independent units, not {estimate.n}: aggregate more or use t_test"
            )
    difference = _difference(x, y)
    statistic = _statistic(difference)
    return Outcome(difference, statistic, _tail(statistic, None, alternative))


def t_test(x: Estimate, y: Estimate | float = 0.0, alternative: Alternative = "two-sided") -> Outcome:
    """Does x differ from y, a known value or an independent estimate? Student statistic.

    The degrees of freedom are the estimate's own (``n-1``, or the effective number that
    :func:`~mbtf_core.stats.mean_of_halves` gives); those of two combine after Welch and Satterthwaite.
    Exact for normal noise of equal variance, at any n.

    Parameters
    ----------
    x : Estimate
    y : Estimate or float
        A known value or an independent estimate.
    alternative : {"two-sided", "greater", "less"}

    Returns
    -------
    Outcome
    """
    difference = _difference(x, y)
    statistic = _statistic(difference)
    return Outcome(difference, statistic, _tail(statistic, difference.degrees, alternative))


def equivalence_test(x: Estimate, y: Estimate | float, tolerance: float) -> Outcome:
    """Is x within ±tolerance of y? Two one-sided t-tests (Schuirmann 1987).

    The burden of proof is reversed: a **small** p-value shows that the two agree within the
    tolerance, and too little data gives a large one. The statistic is that of the side closer to being
    violated.

    Parameters
    ----------
    x : Estimate
    y : Estimate or float
    tolerance : float
        Largest irrelevant difference, in the unit of the estimates.

    Returns
    -------
    Outcome
    """
    if not tolerance > 0:
        raise ValueError(f"tolerance must be positive, not {tolerance}")
    difference = _difference(x, y)
    room = Estimate(tolerance - abs(difference.value), difference.error, difference.n, difference.dof)
    statistic = _statistic(room)
    return Outcome(difference, statistic, _tail(statistic, difference.degrees, "greater"))


def _p_values(p_values: ArrayLike) -> NDArray[np.float64]:
    p = np.asarray(p_values, np.float64)
    if p.size and not (np.all(p >= 0) and np.all(p <= 1)):
        raise ValueError("p-values must lie in [0, 1]")
    return p


def sidak(p_values: ArrayLike) -> NDArray[np.float64]:
    """p-values corrected for their number m, ``1 - (1-p)^m``: exact for independent tests.

    Parameters
    ----------
    p_values : array_like
        In [0, 1], any shape.

    Returns
    -------
    float64 array
    """
    p = _p_values(p_values)
    with np.errstate(divide="ignore"):
        return -np.expm1(p.size * np.log1p(-p))


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """p-values corrected for their number by Holm's step-down rule (1979). Any shape.

    Bounds the familywise error rate for any dependence between the tests; at least as powerful as Bonferroni.

    Parameters
    ----------
    p_values : array_like
        In [0, 1], any shape.

    Returns
    -------
    float64 array
    """
    p = _p_values(p_values)
    flat = p.ravel()
    order = np.argsort(flat, kind="stable")
    steps = np.maximum.accumulate(flat[order] * (flat.size - np.arange(flat.size)))
    out = np.empty_like(flat)
    out[order] = np.minimum(steps, 1.0)
    return out.reshape(p.shape)

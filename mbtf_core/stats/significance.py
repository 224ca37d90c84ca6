"""Tests of estimates against known values and against each other, and the correction for many of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.stats.estimate import Estimate

Alternative = Literal["two-sided", "greater", "less"]


@dataclass(frozen=True)
class Outcome:
    """Result of one test.

    Attributes
    ----------
    difference : quantity that is tested against zero
    statistic : difference over its error
    p_value : probability of a statistic at least as extreme under the null hypothesis
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


def t_test(x: Estimate, y: Estimate | float = 0.0, alternative: Alternative = "two-sided") -> Outcome:
    """Does x differ from y, a known value or an independent estimate? Student statistic.

    The degrees of freedom are the estimate's own (``n-1``, or the effective number that
    :func:`~mbtf_core.stats.mean_of_halves` gives); those of two combine after Welch and Satterthwaite.
    Exact for normal noise of equal variance, at any n.

    Parameters
    ----------
    x : Estimate
    y : A known value or an independent estimate
    alternative : {"two-sided", "greater", "less"}

    Raises
    ------
    ValueError : an estimate or its error is NaN
    """
    from scipy.special import stdtr

    difference = _difference(x, y)
    value, error = difference.value, difference.error
    if math.isnan(value) or math.isnan(error):
        raise ValueError(f"an estimate of {difference} cannot be tested")
    statistic = 0.0 if value == 0.0 else value / error if error else math.copysign(math.inf, value)
    signs = {"two-sided": -abs(statistic), "greater": -statistic, "less": statistic}
    tails = 2.0 if alternative == "two-sided" else 1.0
    return Outcome(difference, statistic, tails * float(stdtr(difference.degrees, signs[alternative])))


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """p-values corrected for their number by Holm's step-down rule (1979). Any shape.

    Bounds the familywise error rate for any dependence between the tests; at least as powerful as Bonferroni.

    Parameters
    ----------
    p_values : in [0, 1], any shape

    Raises
    ------
    ValueError : A p-value lies outside [0, 1]
    """
    p = np.asarray(p_values, np.float64)
    if not np.all((p >= 0) & (p <= 1)):
        raise ValueError("p-values must lie in [0, 1]")
    flat = p.ravel()
    order = np.argsort(flat, kind="stable")
    out = np.empty_like(flat)
    out[order] = np.minimum(np.maximum.accumulate(flat[order] * np.arange(flat.size, 0, -1)), 1.0)
    return out.reshape(p.shape)

"""A measured number with its standard error, its test, and statistics by group: levels, elevation bands.
Estimates that are pooled from two halves are in :mod:`mbtf_core.stats.paired`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.data.lattice import level_of_sigma
from mbtf_core.directions import ELEVATION_BANDS
from mbtf_core.errors import InputError

Alternative = Literal["two-sided", "greater", "less"]
# A value is significant if it differs from zero by more than so many standard errors.
SIGNIFICANT = 2.0


@dataclass(frozen=True)
class Estimate:
    """An estimate with its standard error; ``str()`` gives ``0.318 ± 0.004``.

    Attributes
    ----------
    value : the estimate, in the unit of its quantity
    error : standard error (one standard deviation), same unit; ``inf`` where it is unknown
    n : number of independent units: queries, groups of queries, or images in the image layout
    dof : degrees of freedom of `error`; None means ``n - 1``
    """

    value: float
    error: float
    n: int
    dof: float | None = None

    @property
    def degrees(self) -> float:
        """Degrees of freedom of the error, at least 1 (what a t-test uses)."""
        return max(1.0, float(self.n - 1) if self.dof is None else self.dof)

    @property
    def relative_error(self) -> float:
        """``error / |value|``; ``inf`` for a value of zero."""
        return self.error / abs(self.value) if self.value else math.inf

    def scaled(self, factor: float) -> Estimate:
        """The estimate of `factor` times the quantity."""
        return Estimate(self.value * factor, self.error * abs(factor), self.n, self.dof)

    def as_dict(self) -> dict[str, Any]:
        """``value``, ``error``, ``n`` as JSON takes them: numbers that are not finite become None."""
        return {
            "value": self.value if math.isfinite(self.value) else None,
            "error": self.error if math.isfinite(self.error) else None,
            "n": self.n,
        }

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> Estimate:
        """Inverse of :meth:`as_dict`: None becomes ``nan``, or ``inf`` of an error."""
        value, error = record["value"], record["error"]
        return cls(math.nan if value is None else value, math.inf if error is None else error, record["n"])

    def __str__(self) -> str:
        if not math.isfinite(self.value):
            return "undefined"
        if not math.isfinite(self.error):
            return f"{self.value:.4g} ± ?"
        if self.error <= 0:
            return f"{self.value:.4g} ± 0"
        exponent = _exponent(max(abs(self.value), self.error))
        scale = exponent if exponent < -3 or exponent > 5 else 0
        value, error = self.value / 10.0**scale, self.error / 10.0**scale
        # One digit of the error, two where the first is a 1, so that rounding costs less than 10%.
        first = _exponent(error)
        places = max(0, -first + (1 if error / 10.0**first < 1.95 else 0))
        text = f"{value:.{places}f} ± {error:.{places}f}"
        return f"({text})e{scale:+03d}" if scale else text


def is_significant(e: Estimate) -> bool:
    """Whether a value differs from zero by more than two standard errors; values not finite count as such."""
    return not math.isfinite(e.value) or abs(e.value) > SIGNIFICANT * e.error


def ratio_of(upper: Estimate, lower: Estimate) -> Estimate:
    """Ratio of two independent estimates; undefined unless the lower one is significantly positive."""
    n = min(upper.n, lower.n)
    if lower.value <= 0 or not is_significant(lower):
        return Estimate(math.nan, math.inf, n)
    value = upper.value / lower.value
    return Estimate(value, math.hypot(upper.error, value * lower.error) / lower.value, n)


def _exponent(x: float) -> int:
    return math.floor(math.log10(x))


def mean_estimate(
    samples: ArrayLike, weights: ArrayLike | None = None, groups: ArrayLike | None = None
) -> Estimate:
    """Mean of samples, with its standard error. Samples are independent, or those of different groups are.

    The sample mean is unbiased, and ``s²/n`` with the ``n-1`` divisor an unbiased estimate of its variance.
    Trailing axes (channels of a query, texels of an image) are averaged first, so their correlation does not
    bias the error. Weighted means are self-normalized, ``Σ w x / Σ w``: consistent, with the delta method's
    error.

    Parameters
    ----------
    samples : (n, ...) array_like
    weights : (n,) array_like, optional
        Ratio of the density that the mean is over to the density that the samples come from, up to a factor.
    groups : (n,) int array_like, optional
        Labels of the groups.

    Returns
    -------
    Estimate
        In the unit of the samples.
    """
    units = per_unit(checked(samples, "samples"))
    n = len(units)
    if weights is None and groups is None:
        error = float(units.std(ddof=1)) / math.sqrt(n) if n > 1 else math.inf
        return Estimate(float(units.mean()), error, n)
    w = unit_weights(weights, n)
    mean = float((w * units).mean())
    return Estimate(mean, *standard_error(w * (units - mean), groups))


def standard_error(residuals: NDArray[np.float64], groups: ArrayLike | None) -> tuple[float, int]:
    """Standard error of a mean by the residuals (n,) about it, whose sum is zero, and the number of
    independent groups: the root of the sum of squares of their sums (Liang and Zeger 1986)."""
    n = len(residuals)
    sums: NDArray[Any] = residuals
    if groups is not None:
        sums = np.bincount(np.unique(group_labels(groups, n), return_inverse=True)[1], residuals)
    count = len(sums)
    if count < 2:
        return math.inf, count
    return float(np.linalg.norm(sums)) / math.sqrt(n * (n / count) * (count - 1)), count


def unit_weights(weights: ArrayLike | None, n: int) -> NDArray[np.float64]:
    """Weights (n,) as float64 with mean 1; all 1 where there are none.

    Raises
    ------
    InputError : NaN or infinity
    ValueError : another length, or not positive
    """
    if weights is None:
        return np.ones(n)
    w = checked(weights, "weights")
    if w.shape != (n,) or not (w > 0).all():
        raise ValueError(f"weights must be {n} positive numbers")
    return w / w.mean()


def checked(array: ArrayLike, name: str) -> NDArray[np.float64]:
    """The array as float64, at least one unit long, every number finite.

    Raises
    ------
    InputError : NaN or infinity, with count and first index
    ValueError : no rows
    """
    out = np.asarray(array, np.float64)
    if out.ndim == 0 or out.shape[0] == 0:
        raise ValueError(f"{name} has no rows")
    bad = ~np.isfinite(out)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise InputError(
            f"{int(bad.sum())} numbers are NaN or infinite, the first at index {first}", where=name
        )
    return out


def per_unit(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over all axes but the first: (n, ...) to (n,)."""
    return array.reshape(len(array), -1).mean(axis=1)


def by_group(
    function: Callable[..., Estimate], groups: ArrayLike, *arrays: ArrayLike | None
) -> dict[int, Estimate]:
    """Evaluate a statistic per group: ``by_group(noise_free_mse, level_groups(sigma), p, a, b)``.

    Parameters
    ----------
    function : a function of this package that takes arrays and returns an Estimate
    groups : (n,) int array_like
        Labels; rows with negative labels are ignored.
    *arrays : (n, ...) array_like, or None
        Arguments of the function, the first of them an array.

    Returns
    -------
    dict of int to Estimate
        Estimate of each group from its own rows, by ascending label.
    """
    labels = group_labels(groups, len(np.asarray(arrays[0])))
    rows = [None if array is None else np.asarray(array) for array in arrays]
    return {
        int(label): function(*(None if array is None else array[labels == label] for array in rows))
        for label in np.unique(labels[labels >= 0])
    }


def group_labels(groups: ArrayLike, n: int) -> NDArray[np.int64]:
    """Labels as an (n,) integer array.

    Raises
    ------
    ValueError : another length, or not integers
    """
    labels = np.asarray(groups)
    if labels.shape != (n,) or not np.issubdtype(labels.dtype, np.integer):
        raise ValueError(f"groups must be {n} integers, not {labels.dtype} of shape {labels.shape}")
    return labels.astype(np.int64)


def level_groups(sigma: ArrayLike, finest: int | None = None) -> NDArray[np.int64]:
    """Label footprints with their nearest level, ``round(-log2(2σ))``.

    Parameters
    ----------
    sigma : standard deviations in tile widths, any shape
    finest : labels are clamped to 0..finest
    """
    level = np.rint(level_of_sigma(sigma)).astype(np.int64)
    return np.clip(level, 0, finest)


def elevation_groups(*omegas: ArrayLike, edges: tuple[float, ...] = ELEVATION_BANDS) -> NDArray[np.int64]:
    """Label queries with the elevation band of their most grazing direction.

    Parameters
    ----------
    *omegas : (n, 3) array_like
        Unit vectors, such as ω_i and ω_o.
    edges : band i is ``edges[i] ≤ cos θ < edges[i+1]``; the last band includes its upper edge

    Returns
    -------
    (n,) int64 array
    """
    cosine = np.min([np.asarray(w, np.float64)[..., 2] for w in omegas], axis=0)
    return np.clip(np.searchsorted(edges, cosine, side="right") - 1, 0, len(edges) - 2).astype(np.int64)


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
    """Whether x differs from y, a known value or an independent estimate, by Student's statistic.

    The degrees of freedom are the estimate's own (``n-1``, or the effective number that
    :func:`~mbtf_core.stats.mean_of_halves` gives); those of two combine after Welch and Satterthwaite.
    Exact for normal noise of equal variance, at any n.

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

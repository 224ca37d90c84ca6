"""Paired (split-half) estimates: noise, and noise-free error and variance.

Every query q is estimated twice, ``a_q = t_q + α_q`` and ``b_q = t_q + β_q``, with the truth ``t_q`` and
noise α, β of mean zero, independent of each other and between queries. Products of an a with a b therefore
have the expectation they would have without noise; squares of one half do not.

The halves are arrays ``(n,)``, ``(n, channels)`` or ``(items, rows, columns, channels)``. The first axis
counts the independent units. Everything else is averaged within a unit before an error bar is taken: channels
of one query are correlated, and texels of one image share its directions.

Units of a group, such as the queries of several lights per path, share noise: groups (n,) then label the
independent ones. Units that were not drawn from the distribution that a mean is over have weights (n,), the
ratio of both densities up to a factor, such as the array ``weight`` of test queries. Weighted means are
self-normalized.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.stats.estimate import Estimate, checked, mean_estimate, per_unit, standard_error, unit_weights

# Standard deviation, in pixels, of the averaging window of local errors.
_LOCAL_WINDOW = 2.0


def _pair(a: ArrayLike, b: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    first, second = checked(a, "value_a"), checked(b, "value_b")
    if first.shape != second.shape:
        raise ValueError(f"halves need equal shapes, not {first.shape} and {second.shape}")
    return first, second


def _with_prediction(
    prediction: ArrayLike, a: ArrayLike, b: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    first, second = _pair(a, b)
    p = checked(prediction, "prediction")
    if p.shape != first.shape:
        raise ValueError(f"prediction has the shape {p.shape}, the halves {first.shape}")
    return p, first, second


def mean_of_halves(a: ArrayLike, b: ArrayLike) -> Estimate:
    """Mean value over **these** queries, channels averaged; its error is Monte Carlo noise alone.

    Unbiased because each half is. The variance ``Σ (a-b)²/4 / n²`` is unbiased too: ``E(a-b)²`` is ``Var a
    + Var b`` and ``Var (a+b)/2`` a quarter of that. `dof` is the effective number of degrees of freedom of
    this sum of single-pair variances v: Satterthwaite's (1946) ``(Σv)²/Σv²``, where the square of a
    variance from one pair of normal halves is three times too large, hence ``3 (Σv)²/Σv² - 2``. That is 1
    for one query, about n for n similar ones, and small where few queries dominate the noise. Unlike
    :func:`mean_estimate` it does not include the variance over queries.

    Parameters
    ----------
    a, b : (n, ...) array_like, in the values' unit, which is that of the estimate
    """
    first, second = _pair(a, b)
    x, y = per_unit(first), per_unit(second)
    variances = (x - y) ** 2 / 4.0
    n, total = len(x), float(variances.sum())
    dof = 3.0 * total**2 / float((variances**2).sum()) - 2.0 if total > 0 else float(n)
    return Estimate(float((x + y).mean() / 2.0), math.sqrt(total) / n, n, max(1.0, dof))


def pooled_variance(a: ArrayLike, b: ArrayLike) -> Estimate:
    """Noise variance of one query's value ``(a+b)/2``, pooled over queries and channels.

    The mean of ``(a-b)²/4``. Unbiased for any noise, also of different variance in the two halves:
    ``E(a-b)² = Var a + Var b = 4 Var (a+b)/2``.

    Parameters
    ----------
    a, b : (n, ...) array_like; the estimate has their squared unit
    """
    first, second = _pair(a, b)
    return mean_estimate((first - second) ** 2 / 4.0)


def pooled_error(a: ArrayLike, b: ArrayLike) -> Estimate:
    """Root mean square noise of one query's value ``(a+b)/2``, in the values' unit.

    The square root of :func:`pooled_variance`, with the error of the delta method. It is biased by about
    ``-error²/(2 value)``, negligible for more than some hundred queries.

    Parameters
    ----------
    a, b : (n, ...) array_like
    """
    return _root(pooled_variance(a, b))


def pooled_relative_error(a: ArrayLike, b: ArrayLike, weights: ArrayLike | None = None) -> Estimate:
    """Noise of one query's value relative to the mean value, pooled; a pure number.

    The RMS noise over the mean, ``√(mean (a-b)²/4) / mean (a+b)/2``: what runs, forecasts, manifests, cards
    and pictures state as their noise.

    Parameters
    ----------
    a, b : (n, ...) array_like
    weights : (n,) array_like, optional
    """
    first, second = _pair(a, b)
    w, value = unit_weights(weights, len(first)), per_unit((first + second) / 2.0)
    mean = float((w * value).mean())
    # The square of the mean, linear in the values.
    square = w * mean * (2.0 * value - mean)
    return _root(_ratio(w * per_unit((first - second) ** 2 / 4.0), square))


def noise_free_mse(
    prediction: ArrayLike,
    a: ArrayLike,
    b: ArrayLike,
    weights: ArrayLike | None = None,
    groups: ArrayLike | None = None,
) -> Estimate:
    """Mean squared error of a prediction against the truth, without the noise of the reference.

    The mean of ``(p-a)(p-b)`` over queries and channels. Unbiased if p is independent of these halves:
    ``E (p-t-α)(p-t-β) = (p-t)²`` because α and β are independent with mean zero. It may be negative when the
    true error is below the noise.

    Parameters
    ----------
    prediction, a, b : (n, ...) array_like; the estimate has their squared unit
    weights, groups : (n,) array_like, optional
    """
    p, first, second = _with_prediction(prediction, a, b)
    return mean_estimate((p - first) * (p - second), weights, groups)


def mse_difference(
    prediction: ArrayLike,
    other: ArrayLike,
    a: ArrayLike,
    b: ArrayLike,
    weights: ArrayLike | None = None,
    groups: ArrayLike | None = None,
) -> Estimate:
    """Noise-free mean squared error of `prediction` minus that of `other`, compared query by query.

    Negative where `prediction` is better. Shared reference noise cancels, so the error bar is much smaller
    than that of two separate errors. Unbiased like :func:`noise_free_mse`.

    Parameters
    ----------
    prediction, other, a, b : (n, ...) array_like; the estimate has their squared unit
    weights, groups : (n,) array_like, optional
    """
    p, first, second = _with_prediction(prediction, a, b)
    q, _, _ = _with_prediction(other, a, b)
    return mean_estimate((p - first) * (p - second) - (q - first) * (q - second), weights, groups)


def signal_variance(
    a: ArrayLike, b: ArrayLike, weights: ArrayLike | None = None, groups: ArrayLike | None = None
) -> Estimate:
    """Variance of the true values over queries, free of noise: per channel about its mean, then averaged.

    For ``(n, channels)`` the sample covariance of a and b, ``Σ (a-ā)(b-b̄)/(n-1)``: given the queries, every
    a is independent of every b, so its expectation is the covariance of t with itself. For images the
    covariance of the images' means over n compensates the term that ``ā b̄`` subtracts, so the estimate is
    unbiased when whole images are sampled.

    Parameters
    ----------
    a, b : (n, ...) array_like; the estimate has their squared unit
    weights, groups : (n,) array_like, optional
    """
    first, second = _pair(a, b)
    products, correction = _centered_products(first, second, unit_weights(weights, len(first)))
    spread = mean_estimate(products, weights, groups)
    if spread.n < 2:
        return Estimate(math.nan, math.inf, spread.n)
    return Estimate(spread.value + correction, spread.error, spread.n)


def unexplained_variance(
    prediction: ArrayLike,
    a: ArrayLike,
    b: ArrayLike,
    weights: ArrayLike | None = None,
    groups: ArrayLike | None = None,
) -> Estimate:
    """Fraction of unexplained variance, 1 - R²: noise-free MSE over signal variance.

    0 is perfect, 1 no better than the mean value, more is possible. Numerator and denominator are unbiased;
    the ratio is consistent, with a bias of order 1/n. The error bar is the delta method's, from the scatter
    of ``x_q - R y_q`` over units, in which the correlation of both is accounted for. Where the signal
    variance is not even twice its own error the ratio has no meaning: the value is NaN and the error
    infinite.

    Parameters
    ----------
    prediction, a, b : (n, ...) array_like
        The prediction, and independent halves of the reference.
    weights, groups : (n,) array_like, optional

    Raises
    ------
    InputError : a number is NaN or infinite
    ValueError : shapes differ
    """
    p, first, second = _with_prediction(prediction, a, b)
    w = unit_weights(weights, len(p))
    products, correction = _centered_products(first, second, w)
    return _ratio(w * per_unit((p - first) * (p - second)), w * (products + correction), groups)


def psnr(mse: Estimate, peak: float) -> Estimate:
    """PSNR in dB of a mean squared error; infinite where the error is not positive.

    Parameters
    ----------
    mse : noise-free mean squared error, 1/sr²
    peak : value of full scale, 1/sr

    Returns
    -------
    Estimate
        In dB, with the standard error that follows from the one of `mse`.
    """
    if mse.value <= 0 or peak <= 0:
        return Estimate(math.inf, math.inf, mse.n)
    value = 10.0 * math.log10(peak**2 / mse.value)
    return Estimate(value, 10.0 / math.log(10.0) * mse.relative_error, mse.n)


def _centered_products(
    a: NDArray[np.float64], b: NDArray[np.float64], w: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Per unit ``(a-ā)(b-b̄)`` (n,), and what must be added to its mean to make it unbiased, for weights (n,)
    with mean 1."""
    n = len(a)
    channels = a.shape[-1] if a.ndim > 1 else 1
    x, y = a.reshape(n, -1, channels), b.reshape(n, -1, channels)
    # Constant data must come out as exactly zero, without the rounding of their mean.
    x, y = x - x[0, 0], y - y[0, 0]
    each = w[:, None]
    x, y = (v - (each * v.mean(axis=1)).mean(axis=0) for v in (x, y))
    between = float((each**2 * x.mean(axis=1) * y.mean(axis=1)).sum(axis=0).mean())
    return per_unit(x * y), between / (n * (n - 1)) if n > 1 else 0.0


def _ratio(
    numerator: NDArray[np.float64], denominator: NDArray[np.float64], groups: ArrayLike | None = None
) -> Estimate:
    """Ratio of the means of two correlated per-unit arrays (n,), with the delta method's error."""
    below = float(denominator.mean())
    spread, n = standard_error(denominator - below, groups)
    if below <= 2.0 * spread:
        return Estimate(math.nan, math.inf, n)
    ratio = float(numerator.mean()) / below
    error, n = standard_error(numerator - ratio * denominator, groups)
    return Estimate(ratio, error / below, n)


def _root(estimate: Estimate) -> Estimate:
    value = math.sqrt(estimate.value) if estimate.value >= 0 else math.nan
    error = estimate.error / (2.0 * value) if value > 0 else estimate.error
    return Estimate(value, error, estimate.n, estimate.dof)


def local_error(prediction: ArrayLike, a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Local noise-free root mean square error of a picture, in the values' unit.

    The root of the Gaussian average, σ two pixels, of the mean over channels of ``(p-a)(p-b)``. Single
    products are often negative where the error is small compared to the noise, so they are averaged. The map
    is 0 where the average is negative: the error lies below the noise.

    Parameters
    ----------
    prediction, a, b : (rows, columns, channels) array_like
        A picture, and the two independent estimates of its reference.

    Returns
    -------
    (rows, columns) float64 array
    """
    from scipy.ndimage import gaussian_filter

    p, first, second = _with_prediction(prediction, a, b)
    squared = gaussian_filter(((p - first) * (p - second)).mean(axis=-1), _LOCAL_WINDOW, mode="nearest")
    return np.sqrt(np.maximum(squared, 0.0))

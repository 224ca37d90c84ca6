"""A measured number with its standard error."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.errors import InputError


@dataclass(frozen=True)
class Estimate:
    """An estimate with its standard error; ``str()`` gives ``0.318 ± 0.004``.

    Attributes
    ----------
    value : the estimate, in the unit of its quantity
    error : standard error (one standard deviation), same unit; ``inf`` where it is unknown
    n : number of independent units: queries, or images in the image layout
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
        # One digit of the error, two where the first is a 1, so that rounding costs less than 10 %.
        first = _exponent(error)
        places = max(0, -first + (1 if error / 10.0**first < 1.95 else 0))
        text = f"{value:.{places}f} ± {error:.{places}f}"
        return f"({text})e{scale:+03d}" if scale else text


def _exponent(x: float) -> int:
    return math.floor(math.log10(x))


def mean_estimate(samples: ArrayLike) -> Estimate:
    """Mean of independent samples, with its standard error.

    The sample mean is unbiased, and ``s²/n`` with the ``n-1`` divisor an unbiased estimate of its variance.
    Trailing axes (channels of a query, texels of an image) are averaged first, so their correlation does not
    bias the error.

    Parameters
    ----------
    samples : (n, ...) array_like

    Returns
    -------
    Estimate
        In the unit of the samples.
    """
    units = per_unit(checked(samples, "samples"))
    n = len(units)
    error = float(units.std(ddof=1)) / math.sqrt(n) if n > 1 else math.inf
    return Estimate(float(units.mean()), error, n)


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

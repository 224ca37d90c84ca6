"""Elementary functions from +, -, ×, ÷ and √ alone, all of which IEEE 754 rounds exactly.

NumPy's sin, cos, exp and log differ in the last place between processors; queries and their numbers of paths
must not. Relative error below 1e-14, far below the float32 in which queries are stored.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

# Taylor coefficients of sin and cos about 0 in x², to be used on |x| ≤ π/4.
_SIN = tuple((-1) ** k / math.factorial(2 * k + 1) for k in range(8))
_COS = tuple((-1) ** k / math.factorial(2 * k) for k in range(9))
# Taylor coefficients of exp about 0, to be used on |x| ≤ ln(2)/2.
_EXP = tuple(1.0 / float(f) for f in np.cumprod([1.0, *range(1, 16)]))
_LN2 = 0.6931471805599453
# Coefficients of artanh(t)/t about 0 in t², to be used on |t| ≤ 0.1716.
_ARTANH = tuple(1.0 / (2 * k + 1) for k in range(12))


def _horner(coefficients: tuple[float, ...], x: F64) -> F64:
    total = np.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def sincos_turns(turns: F64) -> tuple[F64, F64]:
    """Sine and cosine of angles in turns (angle/2π), any shape."""
    t = np.asarray(turns, np.float64)
    quarter = np.floor(4.0 * t + 0.5)
    x = (t - 0.25 * quarter) * (2.0 * np.pi)
    s, c = x * _horner(_SIN, x * x), _horner(_COS, x * x)
    which = quarter.astype(np.int64) & 3
    return np.choose(which, [s, c, -s, -c]), np.choose(which, [c, -s, -c, s])


def exp2(x: F64) -> F64:
    """2^x, any shape."""
    x = np.asarray(x, np.float64)
    whole = np.floor(x + 0.5)
    return np.ldexp(_horner(_EXP, (x - whole) * _LN2), whole.astype(np.int32))


def exp(x: F64) -> F64:
    """e^x, any shape."""
    return exp2(np.asarray(x, np.float64) / _LN2)


def log(x: F64) -> F64:
    """Natural logarithm of positive numbers, any shape."""
    fraction, power = np.frexp(np.asarray(x, np.float64))
    small = fraction < 0.5**0.5
    fraction = np.where(small, 2.0 * fraction, fraction)
    t = (fraction - 1.0) / (fraction + 1.0)
    return np.asarray(2.0 * t * _horner(_ARTANH, t * t) + (power - small) * _LN2)

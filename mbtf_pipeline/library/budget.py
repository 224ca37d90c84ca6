"""Divides a training time among fits by the errors of equal first fits.

The error of a fit falls about like a power of its training time, e(t) = a t^-b. For a given sum of times the
sum of errors is least where all derivatives agree: t is proportional to a^(1/(1+b)), and equal first fits
measure a.
"""

from __future__ import annotations

from collections.abc import Mapping

# Typical exponent b of the curves in docs/results/2026-11-fit-speed.md.
EXPONENT = 0.5
# No fit gets less than this share of an equal one.
LEAST = 0.25


def divide(total: float, errors: Mapping[str, float | None]) -> dict[str, float]:
    """Training times in seconds.

    Parameters
    ----------
    total : float
        Sum of the times, in seconds.
    errors : mapping of str to float or None
        Unexplained variance of the first fits by name; None where it is undefined, which counts as the mean.

    Returns
    -------
    dict of str to float
        Time by name; none is below a quarter of an equal share.
    """
    known = [max(error, 0.0) for error in errors.values() if error is not None]
    mean = sum(known) / len(known) if known else 1.0
    weights = {
        name: (mean if error is None else max(error, 0.0)) ** (1 / (1 + EXPONENT))
        for name, error in errors.items()
    }
    equal = total / max(len(errors), 1)
    out: dict[str, float] = {}
    # Fits below the least share get that; the rest is divided among the others, which may then fall below.
    while True:
        rest = {name: w for name, w in weights.items() if name not in out}
        left, sum_of = total - sum(out.values()), sum(rest.values())
        times = {name: left * w / sum_of if sum_of > 0 else equal for name, w in rest.items()}
        low = [name for name, time in times.items() if time < LEAST * equal]
        if not low:
            return {name: round((out | times)[name], 3) for name in errors}
        out |= dict.fromkeys(low, LEAST * equal)

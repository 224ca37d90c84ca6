"""Divides a training time among fits by the errors of equal first fits.

The error of a fit falls about like a power of its training time, e(t) = a t^-b. For a given sum of times the
sum of errors is least where all derivatives agree: t is proportional to a^(1/(1+b)), and equal first fits
measure a.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

# Typical exponent b of the error over training time.
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
        Above 1, that of the mean value, it says nothing of further training, and counts as 1.

    Returns
    -------
    dict of str to float
        Time by name; none is below a quarter of an equal share.
    """
    known = [_bounded(error) for error in errors.values() if error is not None]
    mean = sum(known) / len(known) if known else 1.0
    weights = {
        name: (mean if error is None else _bounded(error)) ** (1 / (1 + EXPONENT))
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


def _bounded(error: float) -> float:
    return min(max(error, 0.0), 1.0)


class Division:
    """A training time, divided among the materials of a library.

    Each material has an equal share: part of it is its first fit, the rest goes to a pool that is divided
    among the materials of the pool. A time that was given stays, so that a further material trains no other
    one again: it brings a share of its own. Materials whose options change divide the times that they had.

    Attributes
    ----------
    record : dict
        ``asked``: the options; ``each``: a share in seconds; ``errors`` and ``times`` of the materials by
        name, each with the digest of their options.
    """

    def __init__(self, record: Mapping[str, Any], training: float, first_share: float, count: int) -> None:
        """Continue a division, or begin one if the options have changed.

        Parameters
        ----------
        record : mapping
            That of an earlier command; empty without one.
        training : float
            Sum of all times, in seconds.
        first_share : float
            Part of it for first fits.
        count : int
            Number of materials, failed ones included.
        """
        asked = {"training": training, "first_share": first_share}
        if record.get("asked") == asked:
            self.record = dict(record)
        else:
            self.record = {"asked": asked, "each": training / count, "errors": {}, "times": {}}

    @property
    def first(self) -> float:
        """Training time of a first fit, in seconds."""
        return float(self.record["asked"]["first_share"] * self.record["each"])

    def has_error(self, name: str, key: str) -> bool:
        """Whether the error of a material's first fit is known for the options of this digest."""
        return bool(self.record["errors"].get(name, {}).get("key") == key)

    def add(self, name: str, key: str, error: float | None) -> None:
        """Record the error of a first fit."""
        self.record["errors"][name] = {"key": key, "error": error}

    def times(self, keys: Iterable[tuple[str, str]]) -> dict[str, float]:
        """Training times in seconds of the materials whose first fits have ended.

        Parameters
        ----------
        keys : iterable of (str, str)
            Name and digest of the options.

        Returns
        -------
        dict of str to float
        """
        errors, times = self.record["errors"], self.record["times"]
        known = {name: key for name, key in keys if self.has_error(name, key)}
        new = [name for name, key in known.items() if times.get(name, {}).get("key") != key]
        share = self.record["each"] - self.first
        pool = sum(times[name]["seconds"] if name in times else share for name in new)
        for name, seconds in divide(pool, {name: errors[name]["error"] for name in new}).items():
            times[name] = {"key": known[name], "seconds": seconds}
        return {name: times[name]["seconds"] for name in known}

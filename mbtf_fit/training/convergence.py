"""What a fit's last seconds bought, and where the next ones are best spent."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from mbtf_core.console import clock
from mbtf_fit.formatting import SPLIT_NAMES

# The record that stands for the middle of training lies between these shares of it.
_MIDDLE = (0.35, 0.65)
# A difference counts where it is so many standard errors.
_CLEAR = 2.0
# More doublings of the time than these are as good as never.
_MOST_DOUBLINGS = 12.0


@dataclass(frozen=True)
class Price:
    """How the error fell, and what of it is for want of data.

    Attributes
    ----------
    looks_at : the set of queries that half and end are of, in words
    half, half_error : unexplained variance at half of the training time, and its standard error
    end, end_error : at its end
    halving : seconds of training more that would halve it if every doubling of the time went on to divide it
        as the last one did; None where that did not clearly help. Rates that fall towards the end of training
        flatter the last doubling, so this is a lower bound
    noise_share : share of the held-out queries' error that is the noise of the training queries, which the
        fit has learned; None where it is not clearly above zero
    """

    looks_at: str
    half: float
    half_error: float
    end: float
    end_error: float
    halving: float | None
    noise_share: float | None

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)

    def describe(self) -> str:
        """One line, or two."""
        lines = [
            f"{self.looks_at} {self.half:.3f} ± {self.half_error:.3f} at half of the time, "
            f"{self.end:.3f} ± {self.end_error:.3f} at its end"
        ]
        if self.halving is None:
            lines[0] += ": more training alone would not help much"
        else:
            lines[0] += f"; halving that would take {clock(self.halving)} more at the least"
        if self.noise_share is not None:
            lines.append(
                f"{self.noise_share:.0%} of the error of held-out queries is learned noise of the training "
                "queries: more queries, or more paths per query, would take it away"
            )
        return "\n".join(lines)


def price_of(
    history: list[dict[str, Any]],
    errors: dict[str, Any],
    noise: float | None = None,
    looks_at: str = "test",
) -> Price | None:
    """Price of a finished fit; None where its history does not tell.

    Parameters
    ----------
    history : records of the looks at the error, with ``share``, ``seconds``, ``unexplained`` and its
        ``unexplained_error``
    errors : of the finished fit by split, as plain data
    noise : variance of the noise in the training values over that of the values; None where it is not known
    looks_at : the set, among the errors, that was looked at
    """
    known = [r for r in history if _number(r.get("unexplained")) and _number(r.get("unexplained_error"))]
    middle = [r for r in known if _MIDDLE[0] <= r.get("share", -1.0) <= _MIDDLE[1]]
    if not middle or known[-1].get("share", 0.0) < 1.0:
        return None
    last, half = known[-1], min(middle, key=lambda r: abs(r["share"] - 0.5))
    before, after = half["unexplained"], last["unexplained"]
    spread = math.hypot(half["unexplained_error"], last["unexplained_error"])
    halving = None
    # Both looks are at the same queries, so this asks for more than it must.
    if after > 0 and before - after > _CLEAR * spread:
        doublings = math.log(2.0) / math.log(before / after) * math.log2(last["seconds"] / half["seconds"])
        if doublings < _MOST_DOUBLINGS:
            halving = last["seconds"] * (2.0**doublings - 1.0)
    share = _noise_share(errors, noise)
    return Price(
        looks_at=SPLIT_NAMES[looks_at],
        half=before,
        half_error=half["unexplained_error"],
        end=after,
        end_error=last["unexplained_error"],
        halving=halving,
        noise_share=share,
    )


def _number(x: Any) -> bool:
    return isinstance(x, int | float) and math.isfinite(x)


def _noise_share(errors: dict[str, Any], noise: float | None) -> float | None:
    """A fit that has learned the noise of its training queries misses held-out ones by the variance of what
    it has learned, and seems to miss the training queries by as much less: the difference is twice that.
    Few queries without noise part the two as well, so no more is called learned than there is."""
    found = [errors.get(name, {}).get("unexplained", {}) for name in ("held_out_queries", "training")]
    if noise is None or not all(_number(e.get(k)) for e in found for k in ("value", "error")):
        return None
    held_out, training = found
    learned = min(0.5 * (held_out["value"] - training["value"]), noise)
    spread = 0.5 * math.hypot(held_out["error"], training["error"])
    if held_out["value"] <= 0 or learned <= _CLEAR * spread:
        return None
    return min(1.0, float(learned / held_out["value"]))

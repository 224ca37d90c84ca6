"""Errors in words: whether they are visible, reliable, above 1, or made by outliers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from mbtf_core.stats import SIGNIFICANT

SPLIT_NAMES = {
    "test": "test queries",
    "held_out_queries": "held-out queries",
    "held_out_directions": "held-out directions",
    "training": "training queries",
}
# Smallest PSNR in dB of each word for a fit beside its reference. There, the mean HDR-FLIP of pictures is
# that of grays that differ by 1, 2.3 and 5 in L*; materials vary by 3 dB.
VISIBILITY = (
    (40.0, "not visible"),
    (33.0, "barely visible"),
    (26.0, "visible"),
    (-math.inf, "clearly visible"),
)
ABOVE_ONE = "above 1: worse than the mean value"
# Share of an error that ten of so many queries at least make up. At 0.39, the error of glossy bricks at
# 65 536 queries was half of that at four million, six of its standard errors below.
_DECISIVE, _MANY = 1 / 3, 1000
# Share of an error from which its outliers are named.
_OUTLYING = 0.25


def visibility(split: Mapping[str, Any]) -> tuple[str, str | None]:
    """PSNR as text, and a word of :data:`VISIBILITY`, of the errors of a split; where the error is below its
    own uncertainty, bounds. No word without an error, or where the bounds exclude none."""
    from mbtf_core.color import white_of

    mse, error = split["mse"]["value"], split["mse"]["error"]
    if mse is None or error is None:
        return "PSNR unknown", None
    resolved = mse > SIGNIFICANT * error
    squared = mse if resolved else mse + SIGNIFICANT * error
    if squared <= 0:
        return "PSNR infinite", VISIBILITY[0][1]
    psnr = 10.0 * math.log10(white_of(split["exposure"]) ** 2 / squared)
    word = next(word for least, word in VISIBILITY if psnr >= least)
    if resolved or word == VISIBILITY[0][1]:
        return f"PSNR {'' if resolved else 'above '}{psnr:.1f} dB", word
    if psnr <= 0.0:
        return "PSNR unknown", None
    return f"PSNR above {psnr:.1f} dB", f"{word} at most" if word != VISIBILITY[-1][1] else None


def headline(errors: Mapping[str, Any]) -> str:
    """The split whose errors are reported first: test, else held-out queries, else any."""
    return next((name for name in ("test", "held_out_queries") if name in errors), next(iter(errors)))


def unreliable(split: Mapping[str, Any]) -> str:
    """``unreliable: ten of them make 95% of it``, where so few of many queries decide an error that others
    like them may be missing; empty elsewhere."""
    share = split.get("ten_largest") or 0.0
    if split["n"] < _MANY or share <= _DECISIVE:
        return ""
    return f"unreliable: ten of them make {min(1.0, share):.0%} of it"


def outliers(split: Mapping[str, Any]) -> list[str]:
    """A line on the few predictions that make up much of an error, though noise does not explain them."""
    found = split.get("outliers")
    if split["n"] < _MANY or split.get("includes_noise") or found is None or found["share"] < _OUTLYING:
        return []
    count = "one outlier makes" if found["n"] == 1 else f"{found['n']} outliers make"
    values = f"{found['predicted']:.2g} predicted for {found['value']:.2g}"
    where = "level {:.1f}, elevations of light {:.0f}° and view {:.0f}°, u ({:.3f}, {:.3f})"
    place = where.format(found["level"], *found["elevations"], *found["u"])
    return [f"{count} {min(1.0, found['share']):.0%} of the error: {values}, at {place}"]


def above_one(unexplained: Mapping[str, Any]) -> list[str]:
    """The remark on an unexplained variance that is significantly above 1."""
    value, error = unexplained["value"], unexplained["error"]
    return [ABOVE_ONE] if value is not None and value - SIGNIFICANT * (error or 0.0) >= 1.0 else []


def format_estimate(estimate: Mapping[str, Any]) -> str:
    """Value and standard error."""
    if estimate["value"] is None:
        return "undefined"
    error = "?" if estimate["error"] is None else f"{estimate['error']:.3f}"
    return f"{estimate['value']:.3f} ± {error}"

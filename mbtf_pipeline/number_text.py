"""Text of measured numbers in reports and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from mbtf_core.stats import Estimate

# A value is significant if it differs from zero by more than so many standard errors.
SIGNIFICANT = 2.0
NOT_SIGNIFICANT = "not significant"


def estimate(record: Mapping[str, Any]) -> Estimate:
    """An estimate read from JSON, where values that are not finite are null."""
    value, error = record["value"], record["error"]
    return Estimate(math.nan if value is None else value, math.inf if error is None else error, record["n"])


def is_significant(e: Estimate) -> bool:
    """Whether a value differs from zero by more than two standard errors; values not finite count as such."""
    return not math.isfinite(e.value) or abs(e.value) > SIGNIFICANT * e.error


def estimate_text(
    e: Estimate, factor: float = 1.0, unit: str = "", *, significant: bool | None = None
) -> str:
    """``0.123 ± 0.004``, or ``not significant (0.003 ± 0.004)``; `significant` overrides the value's test."""
    if not math.isfinite(e.value):
        return "undefined"
    text = signed(f"{e.scaled(factor)}{unit}")
    return text if (is_significant(e) if significant is None else significant) else not_significant(text)


def not_significant(text: str) -> str:
    """A number's text marked as not significantly different from zero."""
    return f"{NOT_SIGNIFICANT} ({text})"


def signed(text: str) -> str:
    """The text of a number with a true minus sign."""
    return text.replace("-", "−")


def data_errors(record: Mapping[str, Any]) -> tuple[str, str]:
    """(unexplained variance in percent, MSE in 10⁻³/sr²) of the same queries.

    The former is the latter divided by a variance, so both are marked as significant or neither is.
    """
    unexplained, mse = estimate(record["unexplained"]), estimate(record["mse"])
    significant = is_significant(unexplained) and is_significant(mse)
    return (
        estimate_text(unexplained, 100.0, " %", significant=significant),
        estimate_text(mse, 1e3, significant=significant),
    )


def decibel(psnr: Estimate, mse: Estimate) -> str:
    """PSNR in dB, marked where the MSE is not significant."""
    if not math.isfinite(psnr.value):
        return f"MSE {NOT_SIGNIFICANT}"
    text = signed(f"{psnr} dB")
    return text if is_significant(mse) else f"MSE {not_significant(text)}"


def direction(d: Mapping[str, float]) -> str:
    """``elevation 45°, azimuth −90°``."""
    return signed(f"elevation {d['elevation']:g}°, azimuth {d['azimuth']:g}°")


def short_direction(d: Mapping[str, float]) -> str:
    """``45° / −90°``: elevation and azimuth."""
    return signed(f"{d['elevation']:g}° / {d['azimuth']:g}°")


def width(tiles_across: float) -> str:
    """Width of the field of view."""
    return f"{tiles_across:g} tile{'' if tiles_across == 1 else 's'} across"


def levels_text(found: list[float], finest: int) -> str:
    """Range of levels in an image, and whether the data contain them."""
    low, high = (f"{level:.1f}" for level in found)
    text = f"level {low}" if low == high else f"level {low}–{high}"
    return text if found[1] <= finest + 0.1 else f"{text} (finest level of the data: {finest})"

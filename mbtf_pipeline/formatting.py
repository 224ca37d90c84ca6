"""Measured numbers in the report's words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from mbtf_core.stats import Estimate

# A value within so many standard errors of zero is not told from zero.
BAR = 2.0
BELOW = "below two error bars"


def estimate(record: Mapping[str, Any]) -> Estimate:
    """An estimate read back from JSON, where numbers that are not finite are null."""
    value, error = record["value"], record["error"]
    return Estimate(math.nan if value is None else value, math.inf if error is None else error, record["n"])


def below_bar(e: Estimate) -> bool:
    """Whether a value cannot be told from zero."""
    return math.isfinite(e.value) and abs(e.value) <= BAR * e.error


def error_text(e: Estimate, factor: float = 1.0, unit: str = "", *, told: bool = True) -> str:
    """``0.123 ± 0.004``, or that it lies below two error bars, with both numbers.

    Parameters
    ----------
    told : False where something else already says that the value is not told from zero
    """
    if not math.isfinite(e.value):
        return "not defined"
    text = f"{e.scaled(factor)}{unit}".replace("-", "−")
    return text if told and not below_bar(e) else f"{BELOW} ({text})"


def percent(e: Estimate, *, told: bool = True) -> str:
    """:func:`error_text` in percent."""
    return error_text(e, 100.0, " %", told=told)


def data_errors(record: Mapping[str, Any]) -> tuple[str, str]:
    """(unexplained variance in percent, MSE in 10⁻³/sr²) of the same queries.

    One is the other over a variance with an error bar of its own. So both are told from zero, or neither is.
    """
    unexplained, mse = estimate(record["unexplained"]), estimate(record["mse"])
    told = not below_bar(unexplained) and not below_bar(mse)
    return percent(unexplained, told=told), error_text(mse, 1e3, told=told)


def decibel(psnr: Mapping[str, Any], mse: Mapping[str, Any]) -> str:
    """PSNR in dB; none where the error it stands for lies below two error bars."""
    e, error = estimate(psnr), estimate(mse)
    if not math.isfinite(e.value):
        return f"error {BELOW}"
    text = f"{e} dB".replace("-", "−")
    return f"error {BELOW} ({text})" if below_bar(error) else text


def direction(d: Mapping[str, float]) -> str:
    """``elevation 45°, azimuth −90°``."""
    return f"elevation {d['elevation']:g}°, azimuth {d['azimuth']:g}°".replace("-", "−")


def short_direction(d: Mapping[str, float]) -> str:
    """``45° / −90°``: elevation and azimuth."""
    return f"{d['elevation']:g}° / {d['azimuth']:g}°".replace("-", "−")


def width(tiles_across: float) -> str:
    """Width of the field of view."""
    return f"{tiles_across:g} tile{'' if tiles_across == 1 else 's'} across"


def levels(found: list[float], finest: int) -> str:
    """Levels that a picture asks for, and whether the data have them."""
    low, high = (f"{level:.1f}" for level in found)
    text = f"level {low}" if low == high else f"level {low}–{high}"
    return text if found[1] <= finest + 0.1 else f"{text} (finest of the data {finest})"

"""Parsing and formatting of durations (``90s``, ``2min``), sizes (``500MB``), lists (``1,2,4``)."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer

from mbtf_core.errors import UsageError

# Larger units first; a number without a unit counts seconds or bytes.
_SECONDS = {"h": 3600.0, "min": 60.0, "m": 60.0, "sec": 1.0, "s": 1.0}
_BYTES = {"TB": 1e12, "GB": 1e9, "MB": 1e6, "kB": 1e3, "KB": 1e3, "B": 1.0}


def _parse(text: str | float, units: Mapping[str, float], expected: str) -> float:
    match = re.fullmatch(rf"\s*(-?\d+(?:\.\d+)?(?:e\d+)?)\s*({'|'.join(units)})?\s*", str(text))
    if match is None:
        raise ValueError(f"must be {expected}")
    return float(match[1]) * units.get(match[2], 1.0)


def _format(number: float, units: Mapping[str, float], default: str) -> str:
    unit = next((u for u, size in units.items() if number >= size > 1 and number % size == 0), None)
    return f"{number:g}{default}" if unit is None else f"{number / units[unit]:g}{unit}"


def parse_duration(text: str | float) -> float:
    """Seconds of ``"90s"``, ``"2min"``, ``"1.5h"``, or of a plain number of seconds; a ValueError for others,
    and for those not positive."""
    seconds = _parse(text, _SECONDS, "a duration such as 90s, 2min or 1h")
    if not 0 < seconds <= 1e7:
        raise ValueError("must be a positive duration of at most 1e7 seconds")
    return seconds


def asked_duration(text: str, flag: str) -> float:
    """Seconds of a duration given with a flag of the command line, which the UsageError names where it is
    none."""
    try:
        return parse_duration(text)
    except ValueError as error:
        raise UsageError(str(error), where=flag) from None


def format_duration(seconds: float) -> str:
    """``90s``, ``2min``, ``1h``: the largest unit that needs no fraction."""
    return _format(seconds, _SECONDS, "s")


def parse_size(text: str | float) -> float:
    """Bytes of ``"500MB"``, ``"4GB"``, or of a plain number of bytes, decimal units; a ValueError for others,
    and for those not positive."""
    size = _parse(text, _BYTES, "an amount of memory such as 500MB or 4GB")
    if not 0 < size <= 1e18:
        raise ValueError("must be a positive amount of memory")
    return size


def format_size(size: float) -> str:
    """``500MB``, ``4GB``: the largest unit that needs no fraction."""
    return _format(size, _BYTES, "")


def size_text(size: float) -> str:
    """Readable size: ``95 B``, ``812 kB``, ``64 MB``, ``1.7 GB``."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6)):
        if size >= factor:
            return f"{size / factor:.{1 if size < 10 * factor else 0}f} {unit}"
    return f"{size / 1e3:.0f} kB" if size >= 1e3 else f"{size:.0f} B"


def rate_text(paths_per_second: float) -> str:
    """Readable rate: ``1.26 M paths/s``, ``28 k paths/s``, ``0.8 k paths/s``."""
    if paths_per_second >= 1e5:
        return f"{paths_per_second / 1e6:.2f} M paths/s"
    return f"{paths_per_second / 1e3:.{1 if paths_per_second < 1e4 else 0}f} k paths/s"


# Fields of configurations.
Duration = Annotated[
    float, BeforeValidator(parse_duration), PlainSerializer(format_duration, when_used="json")
]
Size = Annotated[float, BeforeValidator(parse_size), PlainSerializer(format_size, when_used="json")]


def parse_numbers(value: Any) -> Any:
    """Numbers of a text such as ``"1,2,4"``, a ValueError where it is none; any other value as it is."""
    if not isinstance(value, str):
        return value
    try:
        return [float(part) for part in value.split(",")]
    except ValueError:
        raise ValueError("must be numbers separated by commas, such as 1,2,4") from None


def tiles_text(count: float) -> str:
    """``1 tile``, ``2.5 tiles``."""
    return "1 tile" if count == 1 else f"{count:g} tiles"


def clock(seconds: float) -> str:
    """Readable duration: ``0:07``, ``12:03``, ``1:02:03``."""
    whole = max(0, round(seconds))
    hours, rest = divmod(whole, 3600)
    minutes, rest = divmod(rest, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def percent(share: float, digits: int = 2) -> str:
    """A share in percent, rounded to some digits but written out: ``0.49%``."""
    number = 100.0 * share
    if number <= 0.0:
        return "0%"
    places = digits - 1 - math.floor(math.log10(number))
    return f"{round(number, places):.{max(0, places)}f}%"

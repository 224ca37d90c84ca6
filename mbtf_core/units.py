"""Values as people write them: durations such as ``90s``, ``2min``, ``1h``, and lists such as ``1,2,4``."""

from __future__ import annotations

import re
from typing import Any

from mbtf_core.errors import UsageError

_DURATION = re.compile(r"^\s*(\d+(?:\.\d+)?)\s*(s|sec|min|m|h)?\s*$")
_SECONDS = {"s": 1.0, "sec": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, None: 1.0}


def parse_duration(text: str | float) -> float:
    """Seconds of ``"90s"``, ``"2min"``, ``"1.5h"``, or of a plain number of seconds.

    Raises
    ------
    ValueError : none of these, or not positive
    """
    match = _DURATION.match(str(text))
    if match is None:
        raise ValueError("must be a duration such as 90s, 2min or 1h")
    seconds = float(match[1]) * _SECONDS[match[2]]
    if not 0 < seconds <= 1e7:
        raise ValueError("must be a positive duration of at most 1e7 seconds")
    return seconds


def asked_duration(text: str, flag: str) -> float:
    """Seconds of a duration given with a flag of the command line.

    Raises
    ------
    UsageError : it is none; names the flag
    """
    try:
        return parse_duration(text)
    except ValueError as error:
        raise UsageError(str(error), where=flag) from None


def format_duration(seconds: float) -> str:
    """``90s``, ``2min``, ``1h``: the largest unit that needs no fraction."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= size and seconds % size == 0:
            return f"{seconds / size:g}{unit}"
    return f"{seconds:g}s"


def parse_numbers(value: Any) -> Any:
    """Numbers of a text such as ``"1,2,4"``; any other value as it is.

    Raises
    ------
    ValueError : a text that is none
    """
    if not isinstance(value, str):
        return value
    try:
        return [float(part) for part in value.split(",")]
    except ValueError:
        raise ValueError("must be numbers separated by commas, such as 1,2,4") from None

"""Quality presets of all programs, from a quick draft to the sizes of the papers: names and precedence.

A preset overrides the configuration file; ``--set`` and flags override the preset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from mbtf_core.config_file import parse_value, read_yaml
from mbtf_core.nested import merge

Quality = Literal["draft", "standard", "high", "paper"]
QualityOption = Annotated[
    Quality | None,
    Parameter(
        help="Preset of sizes and times; overrides the file of --config; other options override the preset."
    ),
]


def overrides_of(file: Path | None, assignments: Sequence[str]) -> dict[str, Any]:
    """Options of a configuration file and of ``a.b=c``, nested; single values of the latter as text.

    Raises
    ------
    InputError : the file cannot be read
    """
    found = read_yaml(file) if file is not None else {}
    given = dict(found) if isinstance(found, Mapping) else {}
    for text in assignments:
        name, _, value = text.partition("=")
        parsed = parse_value(value)
        merge(given, name.strip().split("."), parsed if isinstance(parsed, Mapping) else value.strip())
    return given


def as_assignments(options: dict[str, Any], prefix: str = "") -> list[str]:
    """Options as ``a.b=c`` of ``--set``."""
    return [f"{prefix}{name}={'null' if value is None else value}" for name, value in options.items()]

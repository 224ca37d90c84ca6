"""Quality presets of the generator, from a quick draft to the sizes of the papers.

A preset overrides the configuration file; ``--set`` and flags override the preset. ``benchmarks/quality.py``
measures the time that each preset takes and the error that it reaches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from mbtf_core.config.nested import merge
from mbtf_core.config.settings import parse_value, read_yaml

Quality = Literal["draft", "standard", "high", "paper"]
QualityOption = Annotated[
    Quality | None,
    Parameter(
        help="Preset of sizes and times; overrides the file of --config; other options override the preset."
    ),
]


def _queries(train: str, spp: int, test: str, test_spp: int) -> dict[str, Any]:
    return {"queries.train": train, "queries.spp": spp, "queries.test": test, "queries.test_spp": test_spp}


RESOLUTION = "queries.resolution"
# Options of the generator by preset, dotted names. Explicit resolutions and maps of lower resolution override
# the resolution of a preset; `paper` uses the map's.
GENERATOR: dict[Quality, dict[str, Any]] = {
    # With half as many queries, fits of glossy materials overfit single bright paths. Test errors are free of
    # noise and limited by their variance over queries, so many test queries get few paths each.
    "draft": {RESOLUTION: 128, **_queries("400/texel", 4, "65536", 16)},
    "standard": {RESOLUTION: 256, **_queries("800/texel", 4, "131072", 32)},
    "high": {RESOLUTION: 512, **_queries("1600/texel", 4, "262144", 128)},
    # Kuznetsov et al. 2021: 200 to 400 queries per texel of 64 paths.
    "paper": _queries("400/texel", 64, "262144", 256),
}


def generator_options(quality: Quality | None, given: Mapping[str, Any]) -> dict[str, Any]:
    """Options of the generator at a quality preset, dotted names; none without a preset.

    Parameters
    ----------
    given : explicit options of file and command line, nested; their resolution overrides the preset's
    """
    queries = given.get("queries")
    explicit = isinstance(queries, Mapping) and queries.get("resolution") is not None
    options = {} if quality is None else GENERATOR[quality]
    return {name: value for name, value in options.items() if not (explicit and name == RESOLUTION)}


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

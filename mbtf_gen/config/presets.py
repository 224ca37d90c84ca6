"""Quality presets: options that belong together, from a quick draft to the sizes of the papers.

A preset overrides the configuration file; ``--set`` and flags override the preset. ``benchmarks/quality.py``
measures the time that each preset takes and the error that it reaches.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from cyclopts import Parameter

Quality = Literal["draft", "standard", "high", "paper"]
QualityOption = Annotated[
    Quality | None,
    Parameter(
        help="Preset of sizes and times; overrides the file of --config; other options override the preset."
    ),
]

# Options of the generator by preset, dotted names.
GENERATOR: dict[Quality, dict[str, Any]] = {
    # With half as many queries, fits of glossy materials overfit single bright paths. Test errors are free of
    # noise and limited by their variance over queries, so many test queries get few paths each.
    "draft": {
        "queries.train": "400/texel",
        "queries.spp": 4,
        "queries.test": "65536",
        "queries.test_spp": 16,
    },
    "standard": {
        "queries.train": "800/texel",
        "queries.spp": 4,
        "queries.test": "131072",
        "queries.test_spp": 32,
    },
    "high": {
        "queries.train": "1600/texel",
        "queries.spp": 4,
        "queries.test": "262144",
        "queries.test_spp": 128,
    },
    # Kuznetsov et al. 2021: 200 to 400 queries per texel of 64 paths.
    "paper": {
        "queries.train": "400/texel",
        "queries.spp": 64,
        "queries.test": "262144",
        "queries.test_spp": 256,
    },
}


def as_assignments(options: dict[str, Any], prefix: str = "") -> list[str]:
    """Options as ``a.b=c`` of ``--set``."""
    return [f"{prefix}{name}={'null' if value is None else value}" for name, value in options.items()]

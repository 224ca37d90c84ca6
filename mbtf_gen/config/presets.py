"""Qualities: settings that belong together, from a first look to the papers' sizes.

A quality is laid over the configuration file and under ``--set`` and flags. What each costs and reaches was
measured by ``benchmarks/quality.py``; see :mod:`mbtf_gen.config.quality_measured`.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

from mbtf_gen.config.quality_measured import help_lines

Quality = Literal["draft", "standard", "high", "paper"]

# The generator's options by quality, dotted names.
GENERATOR: dict[Quality, dict[str, Any]] = {
    # Half as many queries let fits of glossy relief follow single bright paths. Test errors are free of
    # noise: what limits them is how they vary over queries, so paths go to many of them.
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


def quality_help(what: str) -> str:
    """Help text of ``--quality``: what it sets, and what each quality was measured to cost and to reach."""
    return f"{what} {help_lines(get_args(Quality))}"


def as_assignments(options: dict[str, Any], prefix: str = "") -> list[str]:
    """Options as ``a.b=c`` of ``--set``."""
    return [f"{prefix}{name}={'null' if value is None else value}" for name, value in options.items()]

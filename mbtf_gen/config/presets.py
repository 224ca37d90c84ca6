"""Quality presets of the generator, from a quick draft to the sizes of the papers.

A preset overrides the configuration file; ``--set`` and flags override the preset. ``benchmarks/quality.py``
measures the time that each preset takes and the error that it reaches.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mbtf_core.app.options import Quality


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

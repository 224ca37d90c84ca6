"""A recipe at a quality: the generator's and every fit's options, and pictures to match."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mbtf_fit.quality import FITTER
from mbtf_gen.quality import GENERATOR, Quality, as_assignments

from .recipe import fit_names

# Options of the comparison by quality.
COMPARE: dict[Quality, dict[str, Any]] = {
    "draft": {"compare.size": 128, "compare.spp": 32},
    "standard": {"compare.size": 256, "compare.spp": 128},
    "high": {"compare.size": 512, "compare.spp": 256},
    "paper": {"compare.size": 512, "compare.spp": 1024},
}


def quality_assignments(path: Path, quality: Quality | None) -> list[str]:
    """``a.b=c`` that bring the recipe of a file to a quality.

    Raises
    ------
    InputError : the file cannot be read
    """
    if quality is None:
        return []
    out = as_assignments(GENERATOR[quality], "generate.")
    for prefix in fit_names(path):
        out += as_assignments(FITTER[quality], f"{prefix}.")
    return out + as_assignments(COMPARE[quality])

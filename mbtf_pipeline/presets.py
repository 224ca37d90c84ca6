"""Quality presets of a recipe: options of the generator, of every fit, and of the comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mbtf_fit.presets import fitter_options, overrides_of
from mbtf_gen.config.presets import GENERATOR, Quality, as_assignments
from mbtf_pipeline.recipe import fit_names

# Options of the comparison by preset.
COMPARE: dict[Quality, dict[str, Any]] = {
    "draft": {"compare.size": 128, "compare.spp": 32},
    "standard": {"compare.size": 256, "compare.spp": 128},
    "high": {"compare.size": 512, "compare.spp": 256},
    "paper": {"compare.size": 512, "compare.spp": 1024},
}


def quality_assignments(path: Path, quality: Quality | None, assignments: Sequence[str] = ()) -> list[str]:
    """Assignments ``a.b=c`` that apply a preset to the recipe of a file.

    Parameters
    ----------
    assignments : those that will override them

    Raises
    ------
    InputError : the file cannot be read
    """
    if quality is None:
        return []
    out = as_assignments(GENERATOR[quality], "generate.")
    given = overrides_of(path, assignments)
    fits = {prefix: _options_of_fit(given, prefix) for prefix in fit_names(path)}
    for prefix, options in fitter_options(quality, fits).items():
        out += as_assignments(options, f"{prefix}.")
    return out + as_assignments(COMPARE[quality])


def _options_of_fit(given: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """The options set for one fit, with its model: by default that of its name."""
    _, _, name = prefix.partition(".")
    fits = given.get("fit")
    fit = fits.get(name) if name and isinstance(fits, Mapping) else fits
    return {"model": name or "neumip", **(fit if isinstance(fit, Mapping) else {})}

"""Quality presets of a recipe: options of the generator, of every fit, and of the comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mbtf_core.config_file import resolve
from mbtf_fit.config import FitConfig
from mbtf_fit.presets import FITTER, best_at, fitter_options, overrides_of
from mbtf_gen.config.presets import GENERATOR, Quality, as_assignments
from mbtf_pipeline.recipe import fit_names
from mbtf_pipeline.stages import hash_of

# Options of the comparison by quality preset.
COMPARE: dict[Quality, dict[str, Any]] = {
    "draft": {"compare.size": 128, "compare.spp": 32},
    "standard": {"compare.size": 256, "compare.spp": 128},
    "high": {"compare.size": 512, "compare.spp": 256},
    "paper": {"compare.size": 512, "compare.spp": 1024},
}


def quality_assignments(path: Path, quality: Quality | None, assignments: Sequence[str] = ()) -> list[str]:
    """Assignments ``a.b=c`` that apply a quality preset to a recipe file.

    Parameters
    ----------
    assignments : explicit ones, which override the preset

    Raises
    ------
    InputError : the file cannot be read
    """
    if quality is None:
        return []
    out = as_assignments(GENERATOR[quality], "generate.")
    given = overrides_of(path, assignments)
    overrides = {prefix: _overrides_of_fit(given, prefix) for prefix in fit_names(path)}
    for prefix, options in fitter_options(quality, overrides).items():
        out += as_assignments(options, f"{prefix}.")
    return out + as_assignments(COMPARE[quality])


def _overrides_of_fit(given: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Explicit options of one fit, including its model; the default model is the name of the fit."""
    _, _, name = prefix.partition(".")
    fits = given.get("fit")
    fit = fits.get(name) if name and isinstance(fits, Mapping) else fits
    return {"model": name or "neumip", **(fit if isinstance(fit, Mapping) else {})}


def settings_hash(quality: Quality) -> str:
    """Hash of all options of a preset and of the resulting training options.

    Measurements with another hash are out of date."""
    options = best_at(quality) | FITTER[quality]
    training = resolve(FitConfig, assignments=as_assignments(options)).training.model_dump(mode="json")
    return hash_of([GENERATOR[quality], options, training, COMPARE[quality]])[:12]

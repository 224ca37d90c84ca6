"""A recipe at a quality: the generator's and every fit's options, and pictures to match."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mbtf_core.config_file import resolve
from mbtf_core.digest import data_sha256
from mbtf_fit.config import FitConfig
from mbtf_fit.presets import FITTER, best_at, fitter_options, overrides_of
from mbtf_gen.config.presets import GENERATOR, Quality, as_assignments
from mbtf_pipeline.recipe import fit_names

# Options of the comparison by quality.
COMPARE: dict[Quality, dict[str, Any]] = {
    "draft": {"compare.size": 128, "compare.spp": 32},
    "standard": {"compare.size": 256, "compare.spp": 128},
    "high": {"compare.size": 512, "compare.spp": 256},
    "paper": {"compare.size": 512, "compare.spp": 1024},
}


def quality_assignments(path: Path, quality: Quality | None, assignments: Sequence[str] = ()) -> list[str]:
    """``a.b=c`` that bring the recipe of a file to a quality.

    Parameters
    ----------
    assignments : those that will be laid over them

    Raises
    ------
    InputError : the file cannot be read
    """
    if quality is None:
        return []
    out = as_assignments(GENERATOR[quality], "generate.")
    prefixes = fit_names(path)
    said = overrides_of(path, assignments)
    for prefix, options in fitter_options(quality, {p: _said_of_fit(said, p) for p in prefixes}).items():
        out += as_assignments(options, f"{prefix}.")
    return out + as_assignments(COMPARE[quality])


def _said_of_fit(said: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """What is said of one fit, with its model: that of its name where none is said."""
    _, _, name = prefix.partition(".")
    fits = said.get("fit")
    fit = fits.get(name) if name and isinstance(fits, Mapping) else fits
    return {"model": name or "neumip", **(fit if isinstance(fit, Mapping) else {})}


def settings_hash(quality: Quality) -> str:
    """Hash of all that a quality sets, and of how the fitter trains otherwise: figures that were measured
    with other settings are out of date."""
    options = best_at(quality) | FITTER[quality]
    training = resolve(FitConfig, assignments=as_assignments(options)).training.model_dump(mode="json")
    return data_sha256([GENERATOR[quality], options, training, COMPARE[quality]])[:12]

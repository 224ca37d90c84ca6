"""Quality presets of a recipe: options of the generator, of every fit, and of the comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mbtf_core.app.options import Quality
from mbtf_core.config.settings import explicit_options
from mbtf_fit.config import DEFAULT_MODEL, fitter_options
from mbtf_gen.config.generator import RESOLUTION, generator_options
from mbtf_pipeline.recipe import Recipe, fit_names, load_recipe

# Options of the comparison by preset.
COMPARE: dict[Quality, dict[str, Any]] = {
    "draft": {"compare.size": 128, "compare.spp": 32},
    "standard": {"compare.size": 256, "compare.spp": 128},
    "high": {"compare.size": 512, "compare.spp": 256},
    "paper": {"compare.size": 512, "compare.spp": 1024},
}


def quality_options(
    path: Path, quality: Quality | None, assignments: Sequence[str] = (), training: float | None = None
) -> dict[str, Any]:
    """Options, by dotted key, that apply a preset to the recipe of a file.

    Parameters
    ----------
    assignments : ``a.b=c`` that will override them
    training : seconds of training that decide the networks; the preset's by default

    Raises
    ------
    InputError : the file cannot be read
    """
    if quality is None:
        return {}
    given = explicit_options(path, assignments)
    generate = given.get("generate")
    preset = generator_options(quality, generate if isinstance(generate, Mapping) else {})
    out = {f"generate.{key}": value for key, value in preset.items()}
    fits = {prefix: _options_of_fit(given, prefix) for prefix in fit_names(given)}
    for prefix, options in fitter_options(quality, fits, training).items():
        out |= {f"{prefix}.{key}": value for key, value in options.items()}
    return out | COMPARE[quality]


def preset_recipe(
    path: Path, quality: Quality | None, assignments: Sequence[str] = (), training: float | None = None
) -> Recipe:
    """The recipe of a file at a quality preset.

    Parameters
    ----------
    assignments : ``a.b=c``, which override the preset
    training : as in :func:`quality_options`

    Raises
    ------
    InputError : file or material cannot be read
    UsageError : an assignment is invalid
    """
    preset = quality_options(path, quality, assignments, training)
    recipe = load_recipe(path, assignments, presets=preset)
    if f"generate.{RESOLUTION}" not in preset:
        return recipe
    from mbtf_gen.job import Job, limit_resolution

    return recipe.model_copy(update={"generate": limit_resolution(Job.load(recipe.generate)).config})


def _options_of_fit(given: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """The options set for one fit, with its model: by default that of its name."""
    _, _, name = prefix.partition(".")
    fits = given.get("fit")
    fit = fits.get(name) if name and isinstance(fits, Mapping) else fits
    return {"model": name or DEFAULT_MODEL, **(fit if isinstance(fit, Mapping) else {})}

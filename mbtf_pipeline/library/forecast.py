"""Time and disk space that a library takes on this machine, from a pilot with one of its materials."""

from __future__ import annotations

from collections.abc import Sequence

from mbtf_core.errors import MbtfError
from mbtf_core.units import clock, expectation
from mbtf_pipeline.forecast import RunForecast, forecast_run
from mbtf_pipeline.library.recipe import Entry, LibraryRecipe
from mbtf_pipeline.recipe import Recipe


def describe_library(library: LibraryRecipe, found: Sequence[Entry]) -> str:
    """What a library is expected to take, its runs one after the other.

    Parameters
    ----------
    library : LibraryRecipe
    found : sequence of Entry
        Its materials. All count as much as the first one that can be used: a guess where they differ.

    Returns
    -------
    str
        One line; empty if no material can be used.
    """
    recipes = [entry.recipe for entry in found if entry.recipe is not None]
    one = next(filter(None, map(_forecast, recipes)), None)
    if one is None:
        return ""
    configs = [config.training for recipe in recipes for config in recipe.fit.values()]
    training = library.training or sum(config.time for config in configs if config.steps is None)
    shared = library.shared_network or 0.0
    seconds = len(recipes) * (one.seconds - one.training) + training + shared
    text = f"{expectation(seconds, len(recipes) * one.bytes)} (training {clock(training)}"
    text += f", shared network {clock(shared)})" if shared else ")"
    if library.training is None and any(config.steps is not None for config in configs):
        text += ", and fits that count steps"
    return text


def _forecast(recipe: Recipe) -> RunForecast | None:
    try:
        return forecast_run(recipe)
    except MbtfError:
        # Its own run names the fault.
        return None

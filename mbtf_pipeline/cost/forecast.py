"""Expected errors of the fits of a run: from short pilots on its data, where they are generated."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mbtf_core.app.options import command_line
from mbtf_core.data.dataset import is_dataset
from mbtf_core.units import format_duration
from mbtf_fit.config import FitConfig
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run import DataSet, data_sets, layout_of, survey


def forecast_errors(recipe: Recipe, folder: Path, note: Callable[[str], None]) -> dict[str, dict[str, Any]]:
    """Forecast the error of each fit of a run, by pilots where its data in the folder are complete; `note` is
    called before pilots, which take a part of the training time. Returns ``source``, ``text`` and, from
    pilots, the forecast by name of the fit."""
    from mbtf_fit.training.forecast import forecast_fit

    stale = survey(recipe, folder)
    data_of: dict[str, DataSet] = {data.config.queries.layout: data for data in data_sets(recipe)}
    found: dict[str, dict[str, Any]] = {}
    missing: dict[str, str] = {}
    for name, fit in recipe.fit.items():
        data = data_of[layout_of(fit, recipe.generate.queries.layout)]
        if not stale[data.stage] and is_dataset(folder / data.sub):
            note(f"{name}: pilots on the data")
            forecast = forecast_fit(fit, folder / data.sub).error
            found[name] = {"source": "pilots", "text": forecast.describe(), "forecast": forecast.as_dict()}
        else:
            text = missing.setdefault(data.sub, _no_forecast(fit, folder / data.sub))
            found[name] = {"source": None, "text": text}
    return found


def _no_forecast(fit: FitConfig, path: Path) -> str:
    """Why a fit has no forecast, and the command of one on the data that are there, if of other options."""
    text = f"no forecast of the error: {path} has no data of these options yet"
    if not is_dataset(path):
        return text
    steps, time, error = fit.training.steps, fit.training.time.seconds, fit.training.error
    budget = {"steps": steps} if steps else {"time": format_duration(time)}
    command = command_line("mbtf-fit", path, model=fit.model, **budget, error=error, dry_run=True)
    return f"{text}; of those that it has: {command}"

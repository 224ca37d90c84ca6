"""Expected errors of the fits of a run: from a stored cost study of its material, or from short pilots on its
data where they are generated."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mbtf_core.data.dataset import is_dataset
from mbtf_fit.config import FitConfig, best_options
from mbtf_gen.job import Job
from mbtf_pipeline.cost.answers import Evidence, basis_of
from mbtf_pipeline.cost.study import measuring_machine, study_config
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run import DataSet, data_sets, layout_of, survey
from mbtf_pipeline.run_time import RunForecast


def study_folder(recipe: Recipe) -> Path:
    """Folder of a recipe's cost study, by default."""
    return recipe.folder.with_name(f"{recipe.folder.name}-cost")


def has_error(recipe: Recipe, error: float | None) -> Recipe:
    """The recipe with fits that stop at an error; None changes nothing."""
    if error is None:
        return recipe
    fits = {}
    for name, fit in recipe.fit.items():
        data = fit.model_dump()
        fits[name] = FitConfig.model_validate({**data, "training": {**data["training"], "error": error}})
    return recipe.model_copy(update={"fit": fits})


def _studied(fit: FitConfig) -> bool:
    """Whether a cost study fits with the same options: those of least error per time."""
    if fit.training.steps is not None:
        return False
    best = best_options(fit.training.time)
    options = {name: value for name, value in best.items() if name.startswith("network.")}
    usual = FitConfig.model_validate({})
    for name, value in options.items():
        found: Any = fit
        for part in name.split("."):
            found = getattr(found, part)
        if found != value:
            return False
    return fit.model == usual.model


def forecast_errors(
    recipe: Recipe, folder: Path, expected: RunForecast, note: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """Forecast the error of each fit of a run.

    Parameters
    ----------
    recipe : Recipe
        Its fits may have an error to stop at.
    folder : Path
        Of the run, whose data are used where they are complete.
    expected : RunForecast
        Of all stages of the run.
    note : callable
        Called before pilots, which take a part of the training time.

    Returns
    -------
    dict of str to dict
        Name of the fit → ``source``, ``text`` and, from pilots, the forecast.
    """
    from mbtf_fit.training.forecast import forecast_fit

    stale = survey(recipe, folder)
    data_of: dict[str, DataSet] = {data.config.queries.layout: data for data in data_sets(recipe)}
    evidence = Evidence.read(study_folder(recipe))
    if evidence is not None:
        job = Job.load(study_config(recipe.generate, None))
        here = basis_of(job.config, job.material.digests), measuring_machine()["system"]
        evidence = evidence if here == (evidence.basis, evidence.system) else None
    found: dict[str, dict[str, Any]] = {}
    for name, fit in recipe.fit.items():
        data = data_of[layout_of(fit)]
        if evidence is not None and _studied(fit):
            # Of generating and this fit, as the study counts them.
            seconds = expected.generating + (expected.training + expected.evaluating) / len(recipe.fit)
            lines = [evidence.error_after(seconds)]
            if fit.training.error is not None:
                lines.append(evidence.time_of(fit.training.error))
            text = "\n".join(line[1] for line in lines if line is not None)
            if text:
                found[name] = {"source": "study", "text": text}
                continue
        if not stale[data.stage] and is_dataset(folder / data.sub):
            note(f"{name}: pilots on the data")
            forecast = forecast_fit(fit, folder / data.sub).error
            found[name] = {"source": "pilots", "text": forecast.describe(), "forecast": forecast.as_dict()}
        else:
            text = "no forecast of the error: there are neither data nor a cost study of this material"
            found[name] = {"source": None, "text": text}
    return found

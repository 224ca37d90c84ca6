"""What is done for one material of a library, in a process or on a worker of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_json
from mbtf_fit.config import FitConfig
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run_folder import COMPARE, SHARDS

if TYPE_CHECKING:
    from mbtf_core.data.dataset import Dataset
    from mbtf_fit.training.fit import FitResult


def fit_shared(
    config: FitConfig, shards: Sequence[Path], folders: Sequence[Path], decoder: Path
) -> list[dict[str, Any]]:
    """Fit several materials with one network; a task.

    Parameters
    ----------
    config : FitConfig
        Options of the fit.
    shards, folders : sequence of Path
        Data set and folder of each material.
    decoder : Path
        Folder of the network.

    Returns
    -------
    list of dict
        Unexplained variance of each material: ``value``, ``error``, ``n``.

    Raises
    ------
    InputError, PartialError
        As :func:`~mbtf_fit.fit_jointly`.
    """
    from mbtf_fit.training.fit import fit_jointly
    from mbtf_fit.training.fit_folder import identity_of, joint_identity

    group = [_open(folder, config) for folder in shards]
    identities = {
        folder: identity_of(config, data, group) for folder, data in zip(folders, group, strict=True)
    }
    identities[decoder] = joint_identity({str(folder): found for folder, found in identities.items()})
    same = all(_holds(folder, identity) for folder, identity in identities.items())
    results = fit_jointly(config, shards, folders, decoder, overwrite=not same)
    return [_unexplained(done, folder) for done, folder in zip(results, shards, strict=True)]


def shards_of(recipe: Recipe, config: FitConfig, run: Path) -> Path:
    """Folder of the data set that a fit of a run learns from."""
    from mbtf_pipeline.run import data_sets, layout_of

    return run / next(d.sub for d in data_sets(recipe) if d.config.queries.layout == layout_of(config))


def _open(shards: str | Path, config: FitConfig) -> Dataset:
    from mbtf_fit.data.loader import open_data
    from mbtf_fit.models.registry import MODELS

    return open_data(shards, MODELS[config.model].layout, config.model)


def _unexplained(result: FitResult, shards: Path) -> dict[str, Any]:
    """Unexplained variance of a fit to a data set of a run, on the test queries of all fits of the run."""
    errors = result.errors
    if shards.name != SHARDS:
        # A data set of another layout has hardly any test queries.
        from mbtf_core.data.dataset import Dataset
        from mbtf_pipeline.compare.dataset_errors import dataset_errors

        tested = Dataset.open(shards.parent / SHARDS)
        errors = dataset_errors({"fit": result.material}, tested)["fit"]["splits"]
    found = errors.get("test") or errors["held_out_queries"]
    return dict(found["unexplained"])


def _holds(folder: Path, identity: Mapping[str, Any]) -> bool:
    """Whether a folder holds this fit, finished or not; any other one is worth nothing."""
    from mbtf_fit.training.fit_folder import FIT

    try:
        return (FIT.read(folder) or {}).get("hash") == identity["config_hash"]
    except InputError:
        return False


def run_material(recipe: Recipe, folder: Path, command: str) -> dict[str, Any]:
    """Run the recipe of a material; a task.

    Parameters
    ----------
    recipe : Recipe
        Resolved recipe.
    folder : Path
        Folder of the material's run.
    command : str
        For the run's record.

    Returns
    -------
    dict
        ``seconds`` by stage.

    Raises
    ------
    InputError, PartialError
        As :func:`~mbtf_pipeline.run.run_recipe`.
    """
    from mbtf_pipeline.run import run_recipe

    result = run_recipe(recipe, folder, command=command)
    return {"seconds": {name: stage.stamp.seconds for name, stage in result.stages.items()}}


def summarize(folder: Path) -> dict[str, Any]:
    """Errors of the fits of a finished run, and the files of its first picture.

    Raises
    ------
    InputError : a file of the run is missing or corrupt
    """
    from mbtf_pipeline.compare.compare import COMPARISON_NAME

    comparison = read_json(folder / COMPARE / COMPARISON_NAME)
    picture = comparison["pictures"][0]
    reference = next(iter(picture["references"].values()))
    return {
        "fits": {
            name: {
                "unexplained": record["splits"]["test"]["unexplained"],
                "picture": f"{COMPARE}/{picture['fits'][name]['file']}.png",
            }
            for name, record in comparison["test"].items()
        },
        "reference": f"{COMPARE}/{reference['file']}.png",
    }

"""What is done for one material of a library, in a process or on a worker of its own."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from mbtf_core.atomic import read_json
from mbtf_core.cluster.task import worker_threads
from mbtf_core.errors import InputError
from mbtf_pipeline.recipe import Recipe

# Sub-folder of a run with the first fit, whose error divides the training time.
FIRST = "first"


def first_fit(recipe: str, folder: str, working_folder: str, seconds: float, command: str) -> float | None:
    """Generate the data of a material and fit it for a short time.

    Parameters
    ----------
    recipe : str
        Resolved recipe as JSON.
    folder : str
        Folder of the material's run.
    working_folder : str
        Folder that all paths are relative to.
    seconds : float
        Training time.
    command : str
        For the run's record.

    Returns
    -------
    float or None
        Unexplained variance of the recipe's first fit; None where it is undefined.

    Raises
    ------
    InputError, PartialError
        As :func:`~mbtf_pipeline.run.run_recipe`.
    """
    with _in_folder(working_folder):
        from mbtf_fit.training.fit import fit
        from mbtf_pipeline.run import data_sets, generate_data, layout_of

        loaded = Recipe.model_validate_json(recipe)
        run = Path(folder)
        generate_data(loaded, run, command=command)
        name, config = next(iter(loaded.fit.items()))
        data = next(d for d in data_sets(loaded) if d.config.queries.layout == layout_of(config))
        training = config.training.model_copy(update={"time": seconds, "steps": None})
        short = config.model_copy(update={"training": training})
        # An earlier first fit of other options or data is worth nothing.
        result = fit(short, run / data.sub, run / FIRST / name, overwrite=True)
        errors = result.errors
        found = errors.get("test") or errors["held_out_queries"]
        value = found["unexplained"]["value"]
        return None if value is None else float(value)


def run_material(recipe: str, folder: str, working_folder: str, command: str) -> dict[str, Any]:
    """Run the recipe of a material.

    Parameters
    ----------
    recipe, folder, working_folder, command
        As for :func:`first_fit`.

    Returns
    -------
    dict
        ``seconds`` by stage.

    Raises
    ------
    InputError, PartialError
        As :func:`~mbtf_pipeline.run.run_recipe`.
    """
    with _in_folder(working_folder):
        from mbtf_pipeline.run import run_recipe

        result = run_recipe(Recipe.model_validate_json(recipe), Path(folder), command=command)
        return {"seconds": {name: stage.stamp.seconds for name, stage in result.stages.items()}}


def summarize(folder: Path) -> dict[str, Any]:
    """Errors of the fits of a finished run, and the files of its first picture.

    Raises
    ------
    InputError : a file of the run is missing or corrupt
    """
    from mbtf_pipeline.compare.compare import COMPARISON_NAME
    from mbtf_pipeline.run_folder import COMPARE

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


@contextlib.contextmanager
def _in_folder(working_folder: str) -> Any:
    """Work in a folder, with the threads of the worker."""
    import torch

    if not Path(working_folder).is_dir():
        raise InputError("this machine does not see the folder", where=working_folder)
    if (threads := worker_threads()) is not None:
        torch.set_num_threads(threads)
    with contextlib.chdir(working_folder):
        yield

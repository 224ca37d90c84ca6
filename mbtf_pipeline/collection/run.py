"""Runs the recipes of several materials, each in a folder of its own, and writes their page.

Runs that are up to date are kept. A run that fails is named, and the others go on.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.app.console import Console
from mbtf_core.errors import InputError, printable
from mbtf_core.files.atomic import read_json
from mbtf_core.files.folders import OutputKind, owned
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item
from mbtf_pipeline.collection.pages import RUNS, write_page
from mbtf_pipeline.collection.recipes import Collection, PaperRecipe, Planned, seedless
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run import generate_data, run_recipe, slices_folder
from mbtf_pipeline.stages import COMPARE, machine

COLLECTION = OutputKind("collection.json", "mbtf-collection", 1, "a library or paper")


@dataclass(frozen=True)
class CollectionResult:
    """Result of several runs.

    Attributes
    ----------
    page : Path
        HTML file.
    tables : list of Path
        CSV files.
    runs : list of dict
        ``name``, ``material``, ``variant``, ``path``, ``state`` (done, failed, pending or skipped) and
        ``error``; of finished runs also what :func:`run_one` returns.
    """

    page: Path
    tables: list[Path]
    runs: list[dict[str, Any]]

    def names(self, state: str) -> list[str]:
        """Names of the runs in a state."""
        return [run["name"] for run in self.runs if run["state"] == state]


def run_collection(
    recipe: Collection,
    file: Path,
    folder: Path,
    *,
    command: str,
    runner: Runner | None = None,
    quick: bool = False,
    force: bool = False,
    console: Console | None = None,
) -> CollectionResult:
    """Run all recipes of a library or a paper, and write their page.

    Parameters
    ----------
    recipe : Collection
        From :func:`~mbtf_pipeline.collection.recipes.load`.
    file : Path
        Its file; paths of materials are relative to it.
    folder : Path
        Folder of all runs, which are in ``runs/NAME``.
    command : str
        Command that the page shows for reproduction.
    runner : Runner, optional
        Runs the recipes; one after the other in this process by default.
    quick : bool
        Whether to apply the options of the quick size.
    force : bool
        Run every stage.
    console : Console, optional
        Receives progress; quiet by default.

    Returns
    -------
    CollectionResult

    Raises
    ------
    InputError
        The folder cannot be used, the options of all runs are at fault, or no material can be run.
    PartialError
        Another process uses the folder, the disk is full, or the cluster is lost; the same command resumes.
    """
    console, runner = console or Console(quiet=True), runner or Runner()
    planned, skipped = recipe.plan(file, quick)
    # Runs in this process show the progress of their stages.
    shown = console if runner.here else None
    recipes = [_learning(one, planned, recipe, folder) for one in planned]
    with owned(folder):
        resumed = COLLECTION.check(folder)
        before = read_json(folder / COLLECTION.record)["runs"] if resumed else []
        # What an earlier command has made is shown until its run ends.
        earlier = {state["name"]: state for state in before if state["state"] != "skipped"}
        states: dict[str, dict[str, Any]] = {}
        for one in planned:
            about = {"name": one.name, "material": one.material, "variant": one.variant}
            state = earlier.get(one.name, {"state": "pending", "error": ""})
            states[one.name] = {**state, **about, "path": one.recipe.generate.material}
        for name, why in skipped.items():
            # Papers are shown without missing materials.
            missing = isinstance(recipe, PaperRecipe) and not why.path.exists()
            about = {"name": name, "material": name, "variant": "", "path": str(why.path)}
            states[name] = {**about, "state": "skipped" if missing else "failed", "error": why.error}
            console.note(f"{name}: {states[name]['state']}: {why.error}")
        for state in states.values():
            state["path"] = printable(os.path.relpath(state["path"], folder))
        record: dict[str, Any] = {
            "recipe": recipe.model_dump(mode="json"),
            "size": "quick" if quick else "full",
            "command": command,
            "machine": machine(),
            "runs": list(states.values()),
        }
        written = _write(folder, record)
        for made in recipes:
            if any(config.training.materials for config in made.fit.values()):
                generate_data(made, folder / RUNS / made.name, command=command, console=shown)
        items = []
        for made in recipes:
            arguments = {"recipe": made, "folder": folder / RUNS / made.name, "command": command}
            gpu = any(config.device == "cuda" for config in made.fit.values())
            items.append(Item(made.name, {**arguments, "force": force, "console": shown}, gpu=gpu))
        for number, done in enumerate(runner.map(run_one, items, independent=True), 1):
            found = {"state": "failed"} if done.error else {"state": "done", **done.value}
            states[done.name] |= {**found, "error": done.error}
            written = _write(folder, record)
            end = f"failed: {done.error}" if done.error else "done"
            console.note(f"{done.name}: {end} ({number} of {len(items)})")
        return CollectionResult(*written, record["runs"])


def _learning(one: Planned, planned: Sequence[Planned], recipe: Collection, folder: Path) -> Recipe:
    """The recipe of a run, some fits of which also learn from the slices of all other materials."""
    others = [p for p in planned if p.material != one.material and p.variant == one.variant]
    fits = dict(one.recipe.fit)
    for name in fits:
        training = fits[name].training
        if seedless(name) not in recipe.learn_from_others or training.materials:
            continue
        if not (others or training.own_material):
            raise InputError(
                f"the fit '{name}' of {one.name} learns from other materials alone, but there are none",
                hint="add a material to the recipe, or leave this fit out",
            )
        data = (folder / RUNS / p.name / slices_folder(p.recipe) for p in others)
        training = training.model_copy(update={"materials": tuple(map(str, data))})
        fits[name] = fits[name].model_copy(update={"training": training})
    return one.recipe.model_copy(update={"fit": fits})


def run_one(
    recipe: Recipe, folder: Path, command: str, force: bool, console: Console | None
) -> dict[str, Any]:
    """Run a resolved recipe in its folder; a task, whose errors are those of
    :func:`~mbtf_pipeline.run.run_recipe`. Returns ``seconds`` by stage, ``reference`` and ``fits``: errors,
    and files of the first picture."""
    result = run_recipe(recipe, folder, force=force, command=command, console=console)
    picture = result.comparison["pictures"][0]
    fits = {
        name: {
            "unexplained": record["splits"]["test"]["unexplained"],
            "picture": f"{COMPARE}/{picture['fits'][name]['file']}.png",
        }
        for name, record in result.comparison["test"].items()
    }
    reference = next(iter(picture["references"].values()))["file"]
    seconds = {name: stage.seconds for name, stage in result.stages.items()}
    return {"seconds": seconds, "fits": fits, "reference": f"{COMPARE}/{reference}.png"}


def _write(folder: Path, record: Mapping[str, Any]) -> tuple[Path, list[Path]]:
    """Write the record, and the page and tables as they are now; returns their paths."""
    COLLECTION.write(folder, record)
    return write_page(folder, record)


def write_again(folder: Path) -> Path:
    """Write the page and tables of finished runs again; returns the page's path. An InputError where none is
    finished."""
    record = read_json(folder / COLLECTION.record)
    if all(run["state"] != "done" for run in record["runs"]):
        raise InputError("contains no finished run", where=folder, hint="run the recipe again: it resumes")
    with owned(folder):
        return write_page(folder, record)[0]

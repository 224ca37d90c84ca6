"""``mbtf-pipeline list``: the recipes of a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Verbose
from mbtf_core.errors import InputError, MbtfError


def list_recipes(
    folder: Path = Path("pipelines"),
    /,
    *,
    verbose: Verbose = False,
    console: Console = CONSOLE,
) -> None:
    """List the recipes of a folder; with --verbose also the stages that would run, given earlier runs.

    Parameters
    ----------
    folder
        Folder of recipes.
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=folder)
    found = [_entry(path, verbose) for path in sorted(folder.glob("*.y*ml"))]
    lines = []
    for entry in found:
        lines.append(f"{entry['file']}: {entry['error'] or entry['description'] or entry['name']}")
        lines += [f"    {stage}: {state}" for stage, state in entry["stages"].items()]
    console.report({"recipes": found}, "\n".join(lines) or f"{folder}: no recipes")


def _entry(path: Path, verbose: bool) -> dict[str, Any]:
    from mbtf_pipeline.library.entries import is_library_recipe, load_library_recipe
    from mbtf_pipeline.papers.plan import is_paper_recipe, load_paper_recipe
    from mbtf_pipeline.recipe import load_recipe

    entry: dict[str, Any] = {
        "file": str(path),
        "name": None,
        "description": None,
        "error": None,
        "stages": {},
    }
    try:
        if is_paper_recipe(path):
            paper = load_paper_recipe(path, [])
            about = {"name": paper.name, "description": paper.description}
            return entry | about | {"folder": str(paper.folder(False))}
        if is_library_recipe(path):
            library = load_library_recipe(path, [])
            about = {"name": library.name, "description": library.description}
            return entry | about | {"folder": str(library.folder)}
        recipe = load_recipe(path)
        entry |= {"name": recipe.name, "description": recipe.description, "folder": str(recipe.folder)}
        if verbose:
            from mbtf_pipeline.run import survey

            decisions = survey(recipe, recipe.folder)
            entry["stages"] = {name: d.reason or "up to date" for name, d in decisions.items()}
    except MbtfError as error:
        # The recipe's path stands before the message already.
        first = error.message.splitlines()[0]
        rest = first.removeprefix(f"{path}:")
        entry["error"] = f"line {rest}" if rest[:1].isdigit() and rest != first else rest.strip()
    return entry

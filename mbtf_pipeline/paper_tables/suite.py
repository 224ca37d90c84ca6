"""Runs everything a paper recipe asks for; runs that are finished and up to date are kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.atomic import read_json, write_json
from mbtf_core.console import Console
from mbtf_core.errors import InputError
from mbtf_core.folders import check_folder, make_folder
from mbtf_pipeline.paper_tables.recipe import PaperRecipe, Planned
from mbtf_pipeline.run import run_recipe
from mbtf_pipeline.run_folder import locked, machine

PAPER_NAME = "paper.json"
PAPER_FORMAT = "mbtf-paper"
PAPER_SCHEMA = 1
RUNS = "runs"


@dataclass(frozen=True)
class Paper:
    """A finished paper recipe.

    Attributes
    ----------
    folder : of everything; page : the HTML file; tables : CSV files
    record : content of ``paper.json``
    """

    folder: Path
    page: Path
    tables: list[Path]
    record: dict[str, Any]


def is_paper(folder: Path) -> bool:
    """Whether a folder holds a paper recipe's runs."""
    try:
        return bool(read_json(folder / PAPER_NAME).get("format") == PAPER_FORMAT)
    except InputError:
        return False


def run_paper(
    paper: PaperRecipe,
    planned: list[Planned],
    missing: Mapping[str, str],
    folder: Path,
    *,
    quick: bool,
    command: str,
    force: bool = False,
    console: Console | None = None,
) -> Paper:
    """Run all recipes in turn and make the tables.

    Parameters
    ----------
    planned, missing : of :func:`~mbtf_pipeline.paper_tables.recipe.plan`
    command : what the page names as the way to make it again

    Raises
    ------
    InputError : a material or the folder cannot be used
    PartialError : something else works in the folder, or the disk is full; the same command resumes
    """
    from mbtf_pipeline.paper_tables.page import write_page

    console = console or Console(quiet=True)
    check_folder(folder, is_paper, "paper recipe")
    make_folder(folder)
    record: dict[str, Any] = {
        "format": PAPER_FORMAT,
        "schema": PAPER_SCHEMA,
        "name": paper.name,
        "title": paper.title or paper.name,
        "description": paper.description,
        "size": "quick" if quick else "full",
        "command": command,
        "tables": list(paper.tables),
        "skipped": dict(missing),
        "machine": machine(),
        "planned": len(planned),
        "runs": [],
    }
    write_json(folder / PAPER_NAME, record)
    with locked(folder, PAPER_NAME):
        for name, where in missing.items():
            console.note(f"{name}: skipped, {where} is not there")
        for number, one in enumerate(planned, 1):
            console.note(f"{one.name}: run {number} of {len(planned)}")
            run_recipe(one.recipe, folder / RUNS / one.name, force=force, command=command, console=console)
            record["runs"].append({"material": one.material, "variant": one.variant, "name": one.name})
            write_json(folder / PAPER_NAME, record)
        page, tables = write_page(folder, record)
    return Paper(folder, page, tables, record)


def write_again(folder: Path) -> Path:
    """Write page and tables of the runs that are finished again; returns the page's path.

    Raises
    ------
    InputError : no run is finished, or one is damaged
    """
    from mbtf_pipeline.paper_tables.page import write_page

    with locked(folder, PAPER_NAME):
        return write_page(folder, read_json(folder / PAPER_NAME))[0]

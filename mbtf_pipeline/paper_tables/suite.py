"""Runs all recipes of a paper recipe; runs that are up to date are kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.atomic import read_json, write_json
from mbtf_core.console import Console
from mbtf_core.folders import check_folder, make_folder
from mbtf_pipeline.paper_tables.page import write_page
from mbtf_pipeline.paper_tables.recipe import RUNS, PaperRecipe, Planned
from mbtf_pipeline.run import run_recipe
from mbtf_pipeline.run_folder import has_record, locked, machine

PAPER_NAME = "paper.json"
PAPER_FORMAT = "mbtf-paper"
PAPER_SCHEMA = 2


@dataclass(frozen=True)
class PaperResult:
    """Result of a paper recipe.

    Attributes
    ----------
    folder : Path
        Folder of all runs.
    page : Path
        HTML file.
    tables : list of Path
        CSV files.
    record : dict
        Content of ``paper.json``.
    """

    folder: Path
    page: Path
    tables: list[Path]
    record: dict[str, Any]


def is_paper(folder: Path) -> bool:
    """Whether a folder contains the runs of a paper recipe.

    Raises
    ------
    InputError : it contains those of another schema version
    """
    return has_record(folder, PAPER_NAME, PAPER_FORMAT, PAPER_SCHEMA)


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
) -> PaperResult:
    """Run all recipes of a paper recipe and write its page and tables.

    Parameters
    ----------
    paper : PaperRecipe
        From :func:`~mbtf_pipeline.paper_tables.recipe.load_paper_recipe`.
    planned, missing
        From :func:`~mbtf_pipeline.paper_tables.recipe.plan`.
    folder : Path
        Folder of all runs.
    quick : bool
        Whether `planned` is of the quick size.
    command : str
        Command that the page shows for reproduction.
    force : bool
        Run every stage.
    console : Console, optional
        Receives progress; quiet by default.

    Returns
    -------
    PaperResult
        Paths and record.

    Raises
    ------
    InputError
        A material or the folder cannot be used.
    PartialError
        Another process uses the folder, or the disk is full; the same command resumes.
    """
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
            console.note(f"{name}: skipped, {where} does not exist")
        for number, one in enumerate(planned, 1):
            console.note(f"{one.name}: run {number} of {len(planned)}")
            run_recipe(one.recipe, folder / RUNS / one.name, force=force, command=command, console=console)
            record["runs"].append({"material": one.material, "variant": one.variant, "name": one.name})
            write_json(folder / PAPER_NAME, record)
        page, tables = write_page(folder, record)
    return PaperResult(folder, page, tables, record)


def write_again(folder: Path) -> Path:
    """Write the page and tables of the finished runs again; returns the page's path.

    Raises
    ------
    InputError : no run is finished, or one is corrupt
    """
    with locked(folder, PAPER_NAME):
        return write_page(folder, read_json(folder / PAPER_NAME))[0]

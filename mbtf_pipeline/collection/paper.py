"""A paper recipe: runs of its materials and variants, a page and tables of their results."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.app.console import Console
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_json, write_json, write_text
from mbtf_core.files.folders import check_folder, owned
from mbtf_pipeline.collection.check_tables import independence, offsets, timing, weights
from mbtf_pipeline.collection.error_tables import ablations, levels, methods, zooms
from mbtf_pipeline.collection.finished_run import FinishedRun, each_fit
from mbtf_pipeline.collection.recipes import PaperRecipe, Planned, Published, Skipped
from mbtf_pipeline.compare.metrics import DEFINITIONS
from mbtf_pipeline.compare.perceptual_metrics import weights_file
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.report.plots import ERROR_BAR_NOTE
from mbtf_pipeline.report.report import render
from mbtf_pipeline.run import generate_data, run_recipe, slices_folder
from mbtf_pipeline.run_folder import has_record, machine

PAPER_NAME = "paper.json"
PAPER_FORMAT = "mbtf-paper"
PAPER_SCHEMA = 3
PAGE = "paper.html"
# Sub-folders of the runs, and of the CSV files.
RUNS, TABLES = "runs", "tables"
_MAKERS = {f.__name__: f for f in (methods, levels, weights, ablations, timing, offsets, zooms, independence)}


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
    """Whether a folder contains the runs of a paper recipe; those of another schema version are refused."""
    return has_record(folder, PAPER_NAME, PAPER_FORMAT, PAPER_SCHEMA)


def run_paper(
    paper: PaperRecipe,
    planned: Sequence[Planned],
    skipped: Mapping[str, Skipped],
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
    planned, skipped
        From :meth:`PaperRecipe.plan`.
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

    Raises
    ------
    InputError
        A material or the folder cannot be used.
    PartialError
        Another process uses the folder, or the disk is full; the same command resumes.
    """
    console = console or Console(quiet=True)
    record: dict[str, Any] = {
        "format": PAPER_FORMAT,
        "schema": PAPER_SCHEMA,
        "name": paper.name,
        "title": paper.title or paper.name,
        "description": paper.description,
        "size": "quick" if quick else "full",
        "command": command,
        "tables": list(paper.tables),
        "published": [one.model_dump(mode="json") for one in paper.published],
        "skipped": {name: os.path.abspath(one.path) for name, one in skipped.items()},
        "machine": machine(),
        "planned": len(planned),
        "runs": [],
    }
    with owned(folder):
        check_folder(folder, is_paper, "paper recipe")
        write_json(folder / PAPER_NAME, record)
        for name, why in skipped.items():
            console.note(f"{name}: skipped, {why.error}")
        runs = [(one, _learning_recipe(one, planned, paper, folder)) for one in planned]
        for one, recipe in runs:
            if any(config.training.materials for config in recipe.fit.values()):
                console.note(f"{one.name}: data")
                generate_data(recipe, folder / RUNS / one.name, command=command, console=console)
        for number, (one, recipe) in enumerate(runs, 1):
            console.note(f"{one.name}: run {number} of {len(runs)}")
            run_recipe(recipe, folder / RUNS / one.name, force=force, command=command, console=console)
            record["runs"].append({"material": one.material, "variant": one.variant, "name": one.name})
            write_json(folder / PAPER_NAME, record)
        page, tables = _write_page(folder, record)
    return PaperResult(folder, page, tables, record)


def _learning_recipe(one: Planned, planned: Sequence[Planned], paper: PaperRecipe, folder: Path) -> Recipe:
    """The recipe of a run, some fits of which also learn from the slices of all other materials."""
    others = [p for p in planned if p.material != one.material and p.variant == one.variant]
    fits = dict(one.recipe.fit)
    for name in fits.keys() & set(paper.learn_from_others):
        training = fits[name].training
        if training.materials:
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


def write_again(folder: Path) -> Path:
    """Write the page and tables of the finished runs again; returns the page's path."""
    with owned(folder):
        return _write_page(folder, read_json(folder / PAPER_NAME))[0]


def _write_page(folder: Path, record: Mapping[str, Any]) -> tuple[Path, list[Path]]:
    """Write ``paper.html`` and ``tables/*.csv`` of the finished runs; returns their paths."""
    if not record["runs"]:
        raise InputError("contains no finished run", where=folder, hint="run the recipe again: it resumes")
    runs = [FinishedRun.read(r["material"], r["variant"], folder / RUNS / r["name"]) for r in record["runs"]]
    published = [Published.model_validate(one) for one in record["published"]]
    tables = [table for name in record["tables"] for table in _MAKERS[name](runs, published)]
    (folder / TABLES).mkdir(exist_ok=True)
    files = [folder / TABLES / f"{table.key}.csv" for table in tables]
    for file, table in zip(files, tables, strict=True):
        write_text(file, table.csv())
    reports = [(r["name"].replace("_", " "), f"{RUNS}/{r['name']}/report.html") for r in record["runs"]]
    html = render(
        "paper.html",
        record=record,
        tables=tables,
        reports=reports,
        sizes=_sizes(runs),
        definitions=DEFINITIONS,
        error_bar_note=ERROR_BAR_NOTE,
        st_lpips=weights_file() is not None,
    )
    write_text(folder / PAGE, html)
    return folder / PAGE, files


def _sizes(runs: Sequence[FinishedRun]) -> dict[str, Any]:
    """Sizes of the first run, for the head of the page."""
    run = runs[0]
    splits = run.manifest["splits"]
    return {
        "resolution": 2 ** run.comparison["finest"],
        "train": splits["train"]["queries"],
        "spp": splits["train"]["spp"],
        "test": splits["test"]["queries"],
        "test_spp": splits["test"]["spp"],
        "pictures": len(run.pictures),
        "size": run.comparison["size"],
        "picture_spp": run.comparison["spp"],
        "training": max(float(r.fit(fit)["training_seconds"]) for r, fit in each_fit(runs)),
    }

"""Runs all recipes of a paper recipe, keeps those that are up to date, and writes page and tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mbtf_core.app.console import Console
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_json, write_text
from mbtf_core.files.folders import OutputKind, owned
from mbtf_pipeline.compare.metrics import DEFINITIONS
from mbtf_pipeline.compare.st_lpips import weights_file
from mbtf_pipeline.papers.checks import independence, offsets, timing, weights
from mbtf_pipeline.papers.errors import ablations, levels, methods, zooms
from mbtf_pipeline.papers.plan import RUNS, PaperRecipe, Planned
from mbtf_pipeline.papers.published import Published
from mbtf_pipeline.papers.runs import FinishedRun
from mbtf_pipeline.report.plots import ERROR_BAR_NOTE
from mbtf_pipeline.report.report import render
from mbtf_pipeline.run import generate_data, run_recipe, slices_folder
from mbtf_pipeline.run_folder import machine
from mbtf_pipeline.tables import Table

PAPER = OutputKind("paper.json", "mbtf-paper", 3, "a paper recipe")
PAGE = "paper.html"
TABLES = "tables"
_MAKERS: dict[str, Callable[[Sequence[FinishedRun], Sequence[Published]], list[Table]]] = {
    "methods": methods,
    "levels": levels,
    "weights": weights,
    "ablations": ablations,
    "timing": timing,
    "offsets": offsets,
    "zooms": zooms,
    "independence": independence,
}


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
    planned, missing
        From :func:`~mbtf_pipeline.papers.plan.plan`.
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
        "name": paper.name,
        "title": paper.title or paper.name,
        "description": paper.description,
        "size": "quick" if quick else "full",
        "command": command,
        "tables": list(paper.tables),
        "published": [one.model_dump(mode="json") for one in paper.published],
        "skipped": dict(missing),
        "machine": machine(),
        "planned": len(planned),
        "runs": [],
    }
    with owned(folder):
        PAPER.check(folder)
        PAPER.write(folder, record)
        for name, where in missing.items():
            console.note(f"{name}: skipped, {where} does not exist")
        learners = paper.learn_from_others
        planned = [_with_other_materials(one, planned, learners, folder) for one in planned]
        for one in planned:
            if any(config.training.materials for config in one.recipe.fit.values()):
                console.note(f"{one.name}: data")
                generate_data(one.recipe, folder / RUNS / one.name, command=command, console=console)
        for number, one in enumerate(planned, 1):
            console.note(f"{one.name}: run {number} of {len(planned)}")
            run_recipe(one.recipe, folder / RUNS / one.name, force=force, command=command, console=console)
            record["runs"].append({"material": one.material, "variant": one.variant, "name": one.name})
            PAPER.write(folder, record)
        page, tables = _write_page(folder, record)
    return PaperResult(folder, page, tables, record)


def _with_other_materials(
    one: Planned, planned: Sequence[Planned], learners: Sequence[str], folder: Path
) -> Planned:
    """A recipe of which these fits also learn from the slices of all other materials."""
    others = [p for p in planned if p.material != one.material and p.variant == one.variant]
    fits = dict(one.recipe.fit)
    for name, config in fits.items():
        if name in learners and not config.training.materials:
            if not (others or config.training.own_material):
                raise InputError(
                    f"the fit '{name}' of {one.name} learns from other materials alone, but there are none",
                    hint="add a material to the recipe, or leave this fit out",
                )
            data = (folder / RUNS / p.name / slices_folder(p.recipe) for p in others)
            training = config.training.model_copy(update={"materials": tuple(map(str, data))})
            fits[name] = config.model_copy(update={"training": training})
    return replace(one, recipe=one.recipe.model_copy(update={"fit": fits}))


def write_again(folder: Path) -> Path:
    """Write the page and tables of the finished runs again; returns the page's path."""
    with owned(folder):
        return _write_page(folder, read_json(folder / PAPER.record))[0]


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
        "training": max(r.seconds(fit) for r in runs for fit in r.fits),
    }

"""A library: every material has a run in a folder of its own, failures are named, and one page shows all."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from mbtf_core.app.console import Console
from mbtf_core.errors import InputError, printable
from mbtf_core.files.atomic import read_json, write_json, write_text
from mbtf_core.files.folders import check_folder, owned
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item
from mbtf_core.units import clock
from mbtf_pipeline.collection.recipes import LibraryRecipe, Planned, Skipped
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.report.embed import file_uri
from mbtf_pipeline.report.report import render
from mbtf_pipeline.run import run_recipe
from mbtf_pipeline.run_folder import COMPARE, REPORT, VIEWER, has_record, machine
from mbtf_pipeline.tables import estimate, estimate_text

LIBRARY_NAME = "library.json"
LIBRARY_FORMAT = "mbtf-library"
LIBRARY_SCHEMA = 4
PAGE = "library.html"
# Sub-folder of the runs.
MATERIALS = "materials"
# Pixels along a side of a thumbnail.
_SIZE = 160
# States of a material in the order of the page, and their text.
_STATES = {"done": "done", "failed": "failed", "pending": "not run yet"}


@dataclass(frozen=True)
class LibraryResult:
    """Result of a library.

    Attributes
    ----------
    page : Path
        HTML file.
    materials : list of dict
        Name, path, state, error, and of finished runs ``seconds`` by stage and ``fits`` with their errors.
    """

    page: Path
    materials: list[dict[str, Any]]

    @property
    def failed(self) -> dict[str, str]:
        """Why materials failed, by name."""
        return {m["name"]: m["error"] for m in self.materials if m["state"] == "failed"}


def is_library(folder: Path) -> bool:
    """Whether a folder contains a library; those of another schema version are refused."""
    return has_record(folder, LIBRARY_NAME, LIBRARY_FORMAT, LIBRARY_SCHEMA)


def run_library(
    library: LibraryRecipe,
    planned: Sequence[Planned],
    skipped: Mapping[str, Skipped],
    folder: Path,
    *,
    command: str,
    runner: Runner,
    console: Console | None = None,
) -> LibraryResult:
    """Run the recipe of every material, and write the library's page.

    What is up to date is kept. A material that fails is named, and the others go on.

    Parameters
    ----------
    library : LibraryRecipe
    planned, skipped
        From :meth:`LibraryRecipe.plan`.
    folder : Path
        Folder of the library; the runs are in ``materials/NAME``.
    command : str
        Command that the page shows for reproduction.
    runner : Runner
        Of other processes, each of which runs a material at a time.
    console : Console, optional
        Receives progress; quiet by default.

    Returns
    -------
    LibraryResult

    Raises
    ------
    InputError
        The folder cannot be used.
    PartialError
        Another process uses the folder, the disk is full, or the cluster is lost; the same command resumes.
    """
    console = console or Console(quiet=True)
    with owned(folder):
        resumed = check_folder(folder, is_library, "library")
        before = read_json(folder / LIBRARY_NAME)["materials"] if resumed else []
        # What an earlier command has made is shown until its run ends.
        earlier = {state["name"]: state for state in before}
        paths = {one.name: Path(one.recipe.generate.material) for one in planned}
        states: dict[str, dict[str, Any]] = {}
        for name, path in (paths | {name: one.path for name, one in skipped.items()}).items():
            state = earlier.get(name, {"state": "pending", "error": ""})
            states[name] = {**state, "name": name, "path": printable(os.path.relpath(path, folder))}
        for name, one in skipped.items():
            states[name] |= {"state": "failed", "error": one.error}
        record = {
            "format": LIBRARY_FORMAT,
            "schema": LIBRARY_SCHEMA,
            "name": library.name,
            "title": library.title or library.name,
            "description": library.description,
            "command": command,
            "machine": machine(),
            "training": library.training,
            "materials": list(states.values()),
        }
        _write(folder, record)
        items = [_item(one.recipe, folder, command) for one in planned]
        with console.progress(len(items), "library", "materials") as bar:
            for done in runner.map(run_material, items, independent=True):
                state = states[done.name]
                found = {"state": "failed"} if done.error else {"state": "done", **done.value}
                state |= {**found, "error": done.error}
                if done.error:
                    console.note(f"{done.name}: failed: {done.error}")
                _write(folder, record)
                bar.advance(1, f"{done.name}: {state['state']}")
    return LibraryResult(folder / PAGE, list(states.values()))


def _item(recipe: Recipe, folder: Path, command: str) -> Item:
    arguments = {"recipe": recipe, "folder": folder / MATERIALS / recipe.name, "command": command}
    return Item(recipe.name, arguments, gpu=any(config.device == "cuda" for config in recipe.fit.values()))


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
        ``seconds`` by stage, ``reference`` and ``fits``: errors, and files of the first picture.

    Raises
    ------
    InputError, PartialError
        As :func:`~mbtf_pipeline.run.run_recipe`.
    """
    result = run_recipe(recipe, folder, command=command)
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


def _write(folder: Path, record: Mapping[str, Any]) -> None:
    """Record and page as they are now."""
    write_json(folder / LIBRARY_NAME, record)
    write_text(folder / PAGE, library_page(record, folder / MATERIALS))


def write_again(folder: Path) -> Path:
    """Write the page of a library again; returns its path.

    Raises
    ------
    InputError : the folder contains no library
    """
    if not is_library(folder):
        raise InputError("contains no library", where=folder)
    write_text(folder / PAGE, library_page(read_json(folder / LIBRARY_NAME), folder / MATERIALS))
    return folder / PAGE


def library_page(record: Mapping[str, Any], runs: Path) -> str:
    """HTML of a library.

    Parameters
    ----------
    record : mapping
        Content of ``library.json``.
    runs : Path
        Folder of the runs, by name of the material.

    Returns
    -------
    str
    """
    cards = [_card(material, runs / material["name"]) for material in record["materials"]]
    spent: Counter[str] = Counter()
    for material in record["materials"]:
        spent.update(material["seconds"] if material["state"] == "done" else {})
    training = record["training"]
    return render(
        "library.html",
        record=record,
        # The largest errors first: they are what one looks for. Then failures, then the rest.
        cards=sorted(cards, key=lambda c: (c["rank"], -c["error_value"], c["name"])),
        counts=Counter(material["state"] for material in record["materials"]),
        training=None if training is None else clock(training),
        spent=_times(spent),
    )


def _card(material: Mapping[str, Any], run: Path) -> dict[str, Any]:
    """What the page shows of one material."""
    state, done = material["state"], material["state"] == "done"
    fits = []
    for fit, found in material["fits"].items() if done else ():
        error = estimate(found["unexplained"])
        fits.append(
            {
                "name": fit,
                "error": estimate_text(error),
                "value": error.value if math.isfinite(error.value) else 0.0,
                "image": _thumbnail(run / found["picture"]),
            }
        )
    seconds = material["seconds"] if done else {}
    return {
        "name": material["name"],
        "path": material["path"],
        "state": _STATES[state],
        "rank": list(_STATES).index(state),
        "problem": material["error"] if state == "failed" else "",
        "fits": fits,
        "error_value": max((fit["value"] for fit in fits), default=0.0),
        "reference": _thumbnail(run / material["reference"]) if done else None,
        "seconds": sum(seconds.values()),
        "times": _times(seconds),
        "links": [
            (title, f"{run.parent.name}/{run.name}/{file}")
            for title, file in (("report", REPORT), ("viewer", VIEWER))
            if done and (run / file).is_file()
        ],
    }


def _times(seconds: Mapping[str, float]) -> str:
    """Times of stages in words, and their sum."""
    parts = ", ".join(f"{stage} {clock(s)}" for stage, s in seconds.items())
    return f"{clock(sum(seconds.values()))}: {parts}" if parts else ""


def _thumbnail(path: Path) -> str | None:
    """A small picture; None where it is missing or damaged."""
    try:
        return _small(path, path.stat().st_mtime_ns)
    except OSError:
        return None


@lru_cache(maxsize=4096)
def _small(path: Path, changed: int) -> str:
    """A picture of a date."""
    return file_uri(path, _SIZE)

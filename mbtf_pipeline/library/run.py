"""Runs a library: every material in a folder of its own, failures named and skipped, resumable."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.app.console import Console
from mbtf_core.errors import InputError, MbtfError, printable
from mbtf_core.files.atomic import read_json, write_json, write_text
from mbtf_core.files.digest import data_sha256
from mbtf_core.files.folders import check_folder, owned
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item, Result
from mbtf_core.units import format_duration
from mbtf_fit.config import SHARED_PRESET, FitConfig, decoder_models
from mbtf_fit.material.decoder import DECODER_FOLDER
from mbtf_pipeline.library.entries import Entry, LibraryRecipe
from mbtf_pipeline.library.library_page import library_page
from mbtf_pipeline.library.task import fit_shared, run_material, shards_of, summarize
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run_folder import has_record, machine

LIBRARY_NAME = "library.json"
LIBRARY_FORMAT = "mbtf-library"
LIBRARY_SCHEMA = 3
PAGE = "library.html"
# Sub-folders of the runs, and of the fits with a shared network.
MATERIALS, SHARED = "materials", "shared"


@dataclass(frozen=True)
class LibraryResult:
    """Result of a library.

    Attributes
    ----------
    folder : Path
        Folder of the library.
    page : Path
        HTML file.
    record : dict
        Content of ``library.json``.
    """

    folder: Path
    page: Path
    record: dict[str, Any]

    @property
    def failed(self) -> dict[str, str]:
        """Why materials failed, by name."""
        return {m["name"]: m["error"] for m in self.record["materials"] if m["state"] == "failed"}

    @property
    def shared_error(self) -> str:
        """Why there is no shared network; empty if there is one, or none is asked for."""
        return str(self.record["shared"].get("error", ""))


def is_library(folder: Path) -> bool:
    """Whether a folder contains a library; those of another schema version are refused."""
    return has_record(folder, LIBRARY_NAME, LIBRARY_FORMAT, LIBRARY_SCHEMA)


def run_library(
    library: LibraryRecipe,
    found: Sequence[Entry],
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
    found : sequence of Entry
        From :func:`~mbtf_pipeline.library.entries.entries`.
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
        check_folder(folder, is_library, "library")
        run = _LibraryRun(library, folder, command, console, runner)
        return run.run(list(found))


class _LibraryRun:
    """One call of :func:`run_library`."""

    def __init__(
        self, library: LibraryRecipe, folder: Path, command: str, console: Console, runner: Runner
    ) -> None:
        self.library, self.folder, self.command = library, folder, command
        self.console, self.runner = console, runner
        before = read_json(folder / LIBRARY_NAME) if (folder / LIBRARY_NAME).is_file() else {}
        self.before = {state["name"]: state for state in before.get("materials", [])}
        self.shared: dict[str, Any] = before.get("shared", {})
        self.states: dict[str, dict[str, Any]] = {}

    def run(self, found: list[Entry]) -> LibraryResult:
        """All materials, then the page."""
        for entry in found:
            # What an earlier command has made is shown until its run ends.
            state = self.before.get(entry.name, {"state": "pending", "error": ""})
            state |= {"name": entry.name, "path": printable(os.path.relpath(entry.path, self.folder))}
            self.states[entry.name] = state | (
                {"state": "failed", "error": entry.error} if entry.error else {}
            )
        self._write()
        left = [entry for entry in found if entry.recipe is not None]
        items = [self._item(entry) for entry in left]
        with self.console.progress(len(items), "library", "materials") as bar:
            for done in self.runner.map(run_material, items, independent=True):
                state = self.states[done.name]
                self._finish(state, done)
                self._write()
                bar.advance(1, f"{done.name}: {state['state']}")
        if self.library.shared_network is None:
            self.shared = {}
        else:
            self._share([entry for entry in left if self.states[entry.name]["state"] == "done"])
        return LibraryResult(self.folder, self.folder / PAGE, self._write())

    def _share(self, done: list[Entry]) -> None:
        """Fit materials of one model and the same options with one network."""
        assert self.library.shared_network is not None
        asked = {"training": self.library.shared_network, "fit": "", "errors": {}}
        group = _same_fits(done)
        if len(group) < 2:
            self.shared = asked | {
                "error": "fewer than two finished materials have the same model and options"
            }
            return
        _, name = group[0]
        configs = [entry.recipe.fit[fit] for entry, fit in group if entry.recipe is not None]
        training = configs[0].training
        update = {"time": self.library.shared_network, "steps": None, "shared_decoder": True}
        # The defaults of such fits, where the recipe says nothing.
        unset = SHARED_PRESET["training"].keys() - training.model_fields_set
        update |= {key: SHARED_PRESET["training"][key] for key in unset}
        config = configs[0].model_copy(update={"training": training.model_copy(update=update)})
        runs, folder = self.folder / MATERIALS, self.folder / SHARED
        arguments = {
            "config": config,
            "shards": [
                shards_of(entry.recipe, config, runs / entry.name)
                for entry, _ in group
                if entry.recipe is not None
            ],
            "folders": [folder / entry.name for entry, _ in group],
            "decoder": folder / DECODER_FOLDER,
        }
        time = format_duration(self.library.shared_network)
        self.console.note(f"{name}: a shared network of {len(group)} materials, training for {time}")
        item = Item("shared network", arguments, gpu=config.device == "cuda")
        for result in self.runner.map(fit_shared, [item], independent=True):
            found = zip(group, result.value or (), strict=not result.error)
            errors = {entry.name: {"fit": fit, **error} for (entry, fit), error in found}
            self.shared = asked | {"fit": name, "errors": errors, "error": result.error}

    def _item(self, entry: Entry) -> Item:
        assert entry.recipe is not None
        recipe = (
            entry.recipe if self.library.training is None else _timed(entry.recipe, self.library.training)
        )
        arguments = {
            "recipe": recipe,
            "folder": self.folder / MATERIALS / entry.name,
            "command": self.command,
        }
        gpu = any(config.device == "cuda" for config in recipe.fit.values())
        return Item(entry.name, arguments, gpu=gpu)

    def _finish(self, state: dict[str, Any], done: Result) -> None:
        fault = done.error
        if not fault:
            try:
                found = {**done.value, **summarize(self.folder / MATERIALS / state["name"])}
                state |= {"state": "done", "error": "", **found}
                return
            except MbtfError as error:
                fault = " ".join(error.message.split())
        state |= {"state": "failed", "error": fault}
        self.console.note(f"{state['name']}: failed: {fault}")

    def _write(self) -> dict[str, Any]:
        """Record and page as they are now."""
        record = {
            "format": LIBRARY_FORMAT,
            "schema": LIBRARY_SCHEMA,
            "name": self.library.name,
            "title": self.library.title or self.library.name,
            "description": self.library.description,
            "command": self.command,
            "machine": machine(),
            "training": self.library.training,
            "shared": self.shared,
            "materials": list(self.states.values()),
        }
        write_json(self.folder / LIBRARY_NAME, record)
        write_text(self.folder / PAGE, library_page(record, self.folder / MATERIALS))
        return record


def _timed(recipe: Recipe, seconds: float) -> Recipe:
    """A recipe whose fits train for a stated time together."""
    time = {"time": round(seconds / len(recipe.fit), 3), "steps": None}
    fits = {
        name: config.model_copy(update={"training": config.training.model_copy(update=time)})
        for name, config in recipe.fit.items()
    }
    return recipe.model_copy(update={"fit": fits})


def _untimed(config: FitConfig) -> dict[str, Any]:
    """Options of a fit but for its training time."""
    fields = config.fields()
    training = {key: value for key, value in fields["training"].items() if key not in ("time", "steps")}
    return {**fields, "training": training}


def _same_fits(done: Iterable[Entry]) -> list[tuple[Entry, str]]:
    """Most materials whose fits can share a network: with the name of the fit, one of each material."""
    groups: dict[str, dict[str, tuple[Entry, str]]] = {}
    for entry in done:
        for name, config in entry.recipe.fit.items() if entry.recipe is not None else ():
            if config.model in decoder_models() and config.decoder is None and config.init_from is None:
                groups.setdefault(data_sha256(_untimed(config)), {}).setdefault(entry.name, (entry, name))
    return list(max(groups.values(), key=len, default={}).values())


def write_again(folder: Path) -> Path:
    """Write the page of a library again; returns its path.

    Raises
    ------
    InputError : the folder contains no library
    """
    if not is_library(folder):
        raise InputError("contains no library", where=folder)
    record = read_json(folder / LIBRARY_NAME)
    write_text(folder / PAGE, library_page(record, folder / MATERIALS))
    return folder / PAGE

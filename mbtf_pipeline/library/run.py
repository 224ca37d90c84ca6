"""Runs a library: every material in a folder of its own, failures named and skipped, resumable."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mbtf_core.atomic import read_json, write_json, write_text
from mbtf_core.cluster.children import run_in_children
from mbtf_core.cluster.engine import Cluster
from mbtf_core.cluster.task import Task, TaskResult
from mbtf_core.console import Console
from mbtf_core.errors import InputError, MbtfError
from mbtf_core.folders import check_folder, owned
from mbtf_pipeline.library.budget import divide
from mbtf_pipeline.library.page import library_page
from mbtf_pipeline.library.recipe import Entry, LibraryRecipe
from mbtf_pipeline.library.task import summarize
from mbtf_pipeline.run_folder import has_record, machine

LIBRARY_NAME = "library.json"
LIBRARY_FORMAT = "mbtf-library"
LIBRARY_SCHEMA = 1
PAGE = "library.html"
# Sub-folder of the runs.
MATERIALS = "materials"
_TASK = "mbtf_pipeline.library.task"


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


def is_library(folder: Path) -> bool:
    """Whether a folder contains a library; those of another schema version are refused."""
    return has_record(folder, LIBRARY_NAME, LIBRARY_FORMAT, LIBRARY_SCHEMA)


def run_library(
    library: LibraryRecipe,
    found: Sequence[Entry],
    folder: Path,
    *,
    command: str,
    console: Console | None = None,
    cluster: Cluster | None = None,
) -> LibraryResult:
    """Run the recipe of every material, and write the library's page.

    What is up to date is kept. A material that fails is named, and the others go on.

    Parameters
    ----------
    library : LibraryRecipe
    found : sequence of Entry
        From :func:`~mbtf_pipeline.library.recipe.entries`.
    folder : Path
        Folder of the library; the runs are in ``materials/NAME``.
    command : str
        Command that the page shows for reproduction.
    console : Console, optional
        Receives progress; quiet by default.
    cluster : Cluster, optional
        Its workers each run a material at a time; by default one process of this machine after the other.

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
        run = _LibraryRun(library, folder, command, console, cluster)
        return run.run(list(found))


class _LibraryRun:
    """One call of :func:`run_library`."""

    def __init__(
        self, library: LibraryRecipe, folder: Path, command: str, console: Console, cluster: Cluster | None
    ) -> None:
        self.library, self.folder, self.command = library, folder, command
        self.console, self.cluster = console, cluster
        before = read_json(folder / LIBRARY_NAME) if (folder / LIBRARY_NAME).is_file() else {}
        self.first: dict[str, Any] = before.get("first", {})
        self.states: dict[str, dict[str, Any]] = {}

    def run(self, found: list[Entry]) -> LibraryResult:
        """All materials, then the page."""
        for entry in found:
            begin = "failed" if entry.error else "pending"
            self.states[entry.name] = {
                "name": entry.name,
                "path": str(entry.path),
                "state": begin,
                "error": entry.error,
            }
        self._write()
        left = [entry for entry in found if entry.recipe is not None]
        if self.library.training is not None:
            left = self._divided(left)
        tasks = [self._task("run_material", entry) for entry in left]
        with self.console.progress(len(tasks), "library", "materials") as bar:
            for done in self._results(tasks):
                state = self.states[done.task.name]
                self._finish(state, done)
                self._write()
                bar.advance(1, f"{done.task.name}: {state['state']}")
        return LibraryResult(self.folder, self.folder / PAGE, self._write())

    def _divided(self, left: list[Entry]) -> list[Entry]:
        """The materials with the training times that follow from their first fits."""
        assert self.library.training is not None
        each = self.library.training / max(len(left), 1)
        first = self.library.first_share * each
        extra = {"seconds": first}
        kept = {"seconds": first, "materials": sorted(entry.name for entry in left)}
        if self.first.get("asked") != kept:
            tasks = [self._task("first_fit", entry, **extra) for entry in left]
            errors: dict[str, float | None] = {}
            with self.console.progress(len(tasks), "first fits", "materials") as bar:
                for done in self._results(tasks):
                    if done.error:
                        self.states[done.task.name] |= {"state": "failed", "error": done.error}
                    else:
                        errors[done.task.name] = done.value
                    self._write()
                    bar.advance(1, f"{done.task.name}: {'failed' if done.error else 'done'}")
            ordered = {entry.name: errors[entry.name] for entry in left if entry.name in errors}
            rest = self.library.training - first * len(left)
            self.first = {"asked": kept, "errors": ordered, "times": divide(rest, ordered)}
            self._write()
            left = [entry for entry in left if entry.name in errors]
        # A first fit that failed in an earlier run leaves an equal share.
        times = {entry.name: self.first["times"].get(entry.name, each - first) for entry in left}
        return [_timed(entry, times[entry.name]) for entry in left]

    def _task(self, function: str, entry: Entry, **arguments: Any) -> Task:
        assert entry.recipe is not None
        shared = {
            "recipe": entry.recipe.model_dump_json(),
            "folder": str(self.folder / MATERIALS / entry.name),
            "working_folder": str(Path.cwd()),
            "command": self.command,
        }
        return Task(entry.name, f"{_TASK}:{function}", shared | arguments)

    def _results(self, tasks: Iterable[Task]) -> Iterator[TaskResult]:
        if self.cluster is not None:
            return self.cluster.run(tasks, stop_when_fatal=False)
        return run_in_children(tasks)

    def _finish(self, state: dict[str, Any], done: TaskResult) -> None:
        if not done.error:
            try:
                state |= {"state": "done", **done.value, **summarize(self.folder / MATERIALS / state["name"])}
            except MbtfError as error:
                state |= {"state": "failed", "error": " ".join(error.message.split())}
            return
        state |= {"state": "failed", "error": done.error}
        self.console.note(f"{state['name']}: failed: {done.error}")

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
            "first": self.first,
            "materials": list(self.states.values()),
        }
        write_json(self.folder / LIBRARY_NAME, record)
        write_text(self.folder / PAGE, library_page(record, self.folder / MATERIALS))
        return record


def _timed(entry: Entry, seconds: float) -> Entry:
    """A material whose fits train for a stated time together."""
    assert entry.recipe is not None
    fits = {}
    for name, config in entry.recipe.fit.items():
        own = round(seconds / len(entry.recipe.fit), 3)
        training = config.training.model_copy(update={"time": own, "steps": None})
        fits[name] = config.model_copy(update={"training": training})
    return replace(entry, recipe=entry.recipe.model_copy(update={"fit": fits}))


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

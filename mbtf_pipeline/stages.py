"""The folder of a run, and its stages, which run only if their inputs have changed, decided by content and
not by date.

The key of a stage is a hash of its resolved configuration, the digests of its input files, the digests of
the outputs of the stages it needs, and a schema version. After a stage has run, a stamp is written
atomically. It holds the key and the digest of every output file. A stage is up to date if its key equals
that of its stamp and its files match their digests; a stage without a stamp has not run.
"""

from __future__ import annotations

import itertools
import json
import os
import platform
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from mbtf_core.data.documents import software_versions
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import data_sha256, file_sha256, read_json, write_json
from mbtf_core.files.editable import changed
from mbtf_core.files.folders import OutputKind
from mbtf_pipeline.recipe import Recipe, write_recipe

STAMP_FORMAT = "mbtf-stage"
# Part of every key; raised when a stage produces different outputs from the same inputs.
STAGE_SCHEMA = 3
STAMPS = "stages"
FORCED = "forced"
NOT_RUN = "has not run"
# Outputs that people edit, for example to put them into a paper. Pages guard themselves (write_document).
DOCUMENTS = (".csv", ".md", ".png", ".svg", ".yaml")


@dataclass(frozen=True)
class Stage:
    """One step of a recipe.

    Attributes
    ----------
    name : unique; ``fit neumip`` for one fit of several
    needs : names of the stages whose outputs it reads
    config : resolved options, plain data
    inputs : digests of input files from outside the run, by role
    outputs : folders and files that it writes, relative to the run's folder; hidden files do not count
    run : does the work, given why; may return the seconds that it took in all, earlier processes included
    remote : other machines do the work, so that consecutive stages of this kind run at the same time
    """

    name: str
    needs: tuple[str, ...]
    config: Mapping[str, Any]
    inputs: Mapping[str, str]
    outputs: tuple[str, ...]
    run: Callable[[Decision], float | None]
    remote: bool = False


@dataclass(frozen=True)
class Stamp:
    """Record of a finished stage.

    Attributes
    ----------
    key : the hash it ran with
    depends : data covered by the hash
    outputs : file, relative to the run's folder → SHA-256
    seconds : wall-clock time of the run, or the time of the work where earlier processes did some of it
    """

    stage: str
    key: str
    depends: dict[str, Any]
    outputs: dict[str, str]
    seconds: float

    @property
    def outputs_hash(self) -> str:
        """One digest of all outputs."""
        return data_sha256(self.outputs)


class Decision(NamedTuple):
    """Why a stage must run, empty if it is up to date; and outputs that have changed, if that is why."""

    reason: str
    changed_files: tuple[Path, ...] = ()


class StageResult(NamedTuple):
    """Why a stage ran in this run, empty if it was up to date; and the seconds that it took."""

    reason: str
    seconds: float


def stamp_path(folder: Path, stage: str) -> Path:
    """Path of a stage's stamp in a run's folder."""
    return folder / STAMPS / f"{stage.replace(' ', '-')}.json"


def read_stamp(folder: Path, stage: str) -> Stamp | None:
    """A stage's stamp; None if there is none that this version can read."""
    try:
        data = read_json(stamp_path(folder, stage))
        if data.pop("format") != STAMP_FORMAT or data.pop("schema") != STAGE_SCHEMA:
            return None
        return Stamp(**data)
    except (InputError, KeyError, TypeError):
        return None


def _depends(folder: Path, stage: Stage) -> tuple[dict[str, Any], str]:
    """Data that the outputs of a stage depend on, and their hash."""
    stamps = {name: read_stamp(folder, name) for name in stage.needs}
    needs = {name: "" if stamp is None else stamp.outputs_hash for name, stamp in stamps.items()}
    data = {"config": dict(stage.config), "inputs": dict(stage.inputs), "needs": needs}
    plain: dict[str, Any] = json.loads(json.dumps(data))  # as JSON stores it: tuples become lists
    return plain, data_sha256({"schema": STAGE_SCHEMA, "stage": stage.name, **plain})


def _what_changed(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    from mbtf_core.config.settings import differences, in_short

    if changes := differences(old["config"], new["config"]):
        return f"options changed: {in_short(changes, 3)}"
    for part, what in (("inputs", "input"), ("needs", "inputs")):
        before, after = old[part], new[part]
        if names := [n for n in sorted({*before, *after}) if before.get(n) != after.get(n)]:
            return f"{what} changed: {', '.join(names)}"
    return "the version of the stage changed"


def decide(folder: Path, stage: Stage, fresh: Sequence[str] = ()) -> Decision:
    """Whether a stage of the run in `folder` must run; it does if it needs one of the stages in `fresh`."""
    stamp = read_stamp(folder, stage.name)
    if stamp is None:
        return Decision(NOT_RUN)
    depends, key = _depends(folder, stage)
    if stamp.key != key:
        return Decision(_what_changed(stamp.depends, depends))
    changed_files = tuple(
        folder / name
        for name, expected in stamp.outputs.items()
        if not (folder / name).is_file() or file_sha256(folder / name) != expected
    )
    if changed_files:
        what = "is missing" if not changed_files[0].exists() else "has changed"
        return Decision(f"{changed_files[0].relative_to(folder)} {what}", changed_files)
    if after := [n for n in stage.needs if n in fresh]:
        return Decision(f"follows {after[0]}")
    return Decision("")


def _refuse_edited(folder: Path, stage: Stage) -> None:
    """An InputError if a document of a stage has been edited since the stage wrote it."""
    stamp = read_stamp(folder, stage.name)
    for name, expected in {} if stamp is None else stamp.outputs.items():
        path = folder / name
        if path.suffix in DOCUMENTS and path.is_file() and file_sha256(path) != expected:
            raise changed(path, "--force")


# Called before each stage with its name, its decision, and None; after it, with its seconds.
Notify = Callable[[str, Decision, float | None], None]


def run_stages(
    folder: Path,
    stages: Sequence[Stage],
    *,
    force: bool = False,
    notify: Notify = lambda name, decision, seconds: None,
) -> dict[str, StageResult]:
    """Run all stages that are not up to date, in the given order; all of them if forced. Returns their
    results by name."""
    done: dict[str, StageResult] = {}

    def decided(stage: Stage) -> Decision:
        fresh = [name for name, result in done.items() if result.reason]
        decision = Decision(FORCED) if force else decide(folder, stage, fresh)
        if decision.reason and not force:
            _refuse_edited(folder, stage)
        notify(stage.name, decision, None)
        return decision

    def finished(stage: Stage, decision: Decision) -> StageResult:
        stamp = None if decision.reason else read_stamp(folder, stage.name)
        seconds = (stamp or _run(folder, stage, decision)).seconds
        notify(stage.name, decision, seconds)
        return StageResult(decision.reason, seconds)

    for remote, group in itertools.groupby(stages, lambda stage: stage.remote):
        together = list(group)
        if not remote:
            for stage in together:
                done[stage.name] = finished(stage, decided(stage))
            continue
        # Decided before any runs; none needs another.
        decisions = [decided(stage) for stage in together]
        pool = ThreadPoolExecutor(len(together), "stages")
        try:
            running = [pool.submit(finished, *pair) for pair in zip(together, decisions, strict=True)]
            wait(running)
        finally:
            # An interruption does not wait for what other machines do.
            pool.shutdown(wait=False, cancel_futures=True)
        # In the stages' order; the first that failed raises, when all have ended.
        done |= {stage.name: future.result() for stage, future in zip(together, running, strict=True)}
    return done


def _written(folder: Path, stage: Stage) -> list[str]:
    """Files that a stage has written, relative to the run's folder."""
    tops = [folder / path for path in stage.outputs]
    files = {file for top in tops for file in (top, *top.rglob("*")) if file.is_file()}
    names = sorted(file.relative_to(folder).as_posix() for file in files)
    return [name for name in names if "/." not in f"/{name}"]


def _run(folder: Path, stage: Stage, decision: Decision) -> Stamp:
    path = stamp_path(folder, stage.name)
    # Without a stamp, an interrupted stage counts as not run.
    path.unlink(missing_ok=True)
    start = time.perf_counter()
    whole = stage.run(decision) or 0.0
    seconds = max(whole, time.perf_counter() - start)
    depends, key = _depends(folder, stage)
    outputs = {path: file_sha256(folder / path) for path in _written(folder, stage)}
    stamp = Stamp(stage.name, key, depends, outputs, round(seconds, 3))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"format": STAMP_FORMAT, "schema": STAGE_SCHEMA, **vars(stamp)})
    return stamp


RUN = OutputKind("run.json", "mbtf-run", 2, "a run")
_SOFTWARE = ("mbtf", "mitsuba", "drjit", "torch", "numpy", "scipy", "trimesh", "flip-evaluator")
SHARDS, FITS, COMPARE, REPORT = "shards", "fits", "compare", "report.html"
VIEWER = "viewer.html"


def clear(folder: Path) -> None:
    """Remove a sub-folder of a run with everything in it."""
    if folder.exists():
        shutil.rmtree(folder)


def write_run_record(folder: Path, recipe: Recipe, command: str, *, overwrite: bool = False) -> None:
    """Write the resolved recipe and the command into the run's folder; an edited recipe is refused unless it
    is to be overwritten."""
    RUN.write(folder, {"name": recipe.name, "command": command, "machine": machine()})
    write_recipe(recipe, folder, overwrite=overwrite)


def machine() -> dict[str, str]:
    """Versions of the software that results depend on, and the system."""
    found = software_versions(*_SOFTWARE)
    system = f"{platform.system()} {found.pop('machine')}, {os.cpu_count()} processors"
    return {**found, "system": system}

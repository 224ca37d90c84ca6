"""Stages that run only if their inputs have changed, decided by content and not by date.

The key of a stage is a hash of its resolved configuration, the digests of its input files, the digests of
the outputs of the stages it needs, and a schema version. After a stage has run, a stamp is written
atomically. It holds the key and the digest of every output file. A stage is up to date if its key equals
that of its stamp and its files match their digests; a stage without a stamp has not run.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mbtf_core.atomic import read_json, write_json
from mbtf_core.digest import data_sha256, file_sha256
from mbtf_core.errors import InputError

STAMP_FORMAT = "mbtf-stage"
# Part of every key; raised when a stage produces different outputs from the same inputs.
STAGE_SCHEMA = 2
STAMPS = "stages"
FORCED = "forced"
NOT_RUN = "has not run"


@dataclass(frozen=True)
class Stage:
    """One step of a recipe.

    Attributes
    ----------
    name : unique; ``fit neumip`` for one fit of several
    needs : names of the stages whose outputs it reads
    config : resolved options, plain data
    inputs : digests of input files from outside the run, by role
    outputs : lists the files it has written
    run : does the work and returns notes for the stamp
    """

    name: str
    needs: tuple[str, ...]
    config: Mapping[str, Any]
    inputs: Mapping[str, str]
    outputs: Callable[[], Sequence[Path]]
    run: Callable[[Decision], Mapping[str, Any]]


@dataclass(frozen=True)
class Stamp:
    """Record of a finished stage.

    Attributes
    ----------
    key : the hash it ran with
    depends : data covered by the hash
    outputs : file, relative to the run's folder → SHA-256
    seconds : wall-clock time of the run
    notes : returned by the stage
    """

    stage: str
    key: str
    depends: dict[str, Any]
    outputs: dict[str, str]
    seconds: float
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def outputs_hash(self) -> str:
        """One digest of all outputs."""
        return data_sha256(self.outputs)


@dataclass(frozen=True)
class Decision:
    """Whether a stage must run.

    Attributes
    ----------
    reason : why it runs; empty if it is up to date
    changed_files : outputs that are missing or have changed, if that is the reason
    """

    reason: str
    changed_files: tuple[Path, ...] = ()

    @property
    def runs(self) -> bool:
        """Whether the stage must run."""
        return bool(self.reason)

    @property
    def forced(self) -> bool:
        """Whether the user forces it to run, so that nothing of the last run may be kept."""
        return self.reason == FORCED


def stamp_path(folder: Path, stage: str) -> Path:
    """Path of a stage's stamp in a run's folder."""
    return folder / STAMPS / f"{stage.replace(' ', '-')}.json"


def read_stamp(folder: Path, stage: str) -> Stamp | None:
    """A stage's stamp; None if there is none that this version can read."""
    path = stamp_path(folder, stage)
    if not path.exists():
        return None
    try:
        data = read_json(path)
        if data.pop("format") != STAMP_FORMAT or data.pop("schema") != STAGE_SCHEMA:
            return None
        return Stamp(**data)
    except (InputError, KeyError, TypeError):
        return None


def _write_stamp(folder: Path, stamp: Stamp) -> None:
    path = stamp_path(folder, stamp.stage)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"format": STAMP_FORMAT, "schema": STAGE_SCHEMA, **vars(stamp)})


def _depends(stage: Stage, upstream: Mapping[str, str]) -> dict[str, Any]:
    data = {"config": dict(stage.config), "inputs": dict(stage.inputs), "needs": dict(upstream)}
    plain: dict[str, Any] = json.loads(json.dumps(data))  # as JSON stores it: tuples become lists
    return plain


def _key(stage: Stage, depends: Mapping[str, Any]) -> str:
    return data_sha256({"schema": STAGE_SCHEMA, "stage": stage.name, **depends})


def _what_changed(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    from mbtf_core.config_file import differences

    if changes := differences(old.get("config", {}), new["config"]):
        more = f" and {len(changes) - 3} more" if len(changes) > 3 else ""
        return f"options changed: {'; '.join(changes[:3])}{more}"
    before, after = old.get("inputs", {}), new["inputs"]
    if names := [n for n in sorted({*before, *after}) if before.get(n) != after.get(n)]:
        return f"input changed: {', '.join(names)}"
    before, after = old.get("needs", {}), new["needs"]
    names = [n for n in sorted({*before, *after}) if before.get(n) != after.get(n)]
    return f"inputs changed: {', '.join(names)}" if names else "the version of the stage changed"


def decide(folder: Path, stage: Stage, upstream: Mapping[str, str], fresh: Sequence[str] = ()) -> Decision:
    """Whether a stage of the run in `folder` must run.

    Parameters
    ----------
    upstream : digest of the outputs by name of each needed stage
    fresh : stages that have just run; dependent stages run too
    """
    stamp = read_stamp(folder, stage.name)
    if stamp is None:
        return Decision(NOT_RUN)
    depends = _depends(stage, upstream)
    if stamp.key != _key(stage, depends):
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


@dataclass(frozen=True)
class StageResult:
    """Result of one stage in this run: its stamp, whether it ran, and why."""

    stamp: Stamp
    ran: bool
    reason: str


def run_stages(
    folder: Path,
    stages: Sequence[Stage],
    *,
    force: bool = False,
    notify: Callable[[str, Decision, Stamp | None], None] | None = None,
) -> dict[str, StageResult]:
    """Run all stages that are not up to date, in the given order.

    Parameters
    ----------
    force : run every stage
    notify : called before each stage with (stage, decision, None), and after it with its stamp
    """
    done: dict[str, StageResult] = {}
    for stage in stages:
        upstream = {name: done[name].stamp.outputs_hash for name in stage.needs}
        fresh = [name for name, result in done.items() if result.ran]
        decision = Decision(FORCED) if force else decide(folder, stage, upstream, fresh)
        if notify is not None:
            notify(stage.name, decision, None)
        stamp = read_stamp(folder, stage.name)
        if decision.runs or stamp is None:
            stamp = _run(folder, stage, upstream, decision)
        done[stage.name] = StageResult(stamp, decision.runs, decision.reason)
        if notify is not None:
            notify(stage.name, decision, stamp)
    return done


def run_again(folder: Path, stage: Stage) -> Stamp:
    """Run one stage regardless of its state; the stages it needs must have finished.

    Raises
    ------
    InputError : one of them has not finished
    """
    upstream: dict[str, str] = {}
    for name in stage.needs:
        stamp = read_stamp(folder, name)
        if stamp is None:
            raise InputError(
                f"stage '{name}' is not finished", where=folder, hint="run the recipe again: it resumes"
            )
        upstream[name] = stamp.outputs_hash
    return _run(folder, stage, upstream, Decision(FORCED))


def _run(folder: Path, stage: Stage, upstream: Mapping[str, str], decision: Decision) -> Stamp:
    # Without a stamp, an interrupted stage counts as not run.
    stamp_path(folder, stage.name).unlink(missing_ok=True)
    start = time.perf_counter()
    notes = stage.run(decision)
    seconds = time.perf_counter() - start
    depends = _depends(stage, upstream)
    outputs = {path.relative_to(folder).as_posix(): file_sha256(path) for path in sorted(stage.outputs())}
    stamp = Stamp(stage.name, _key(stage, depends), depends, outputs, round(seconds, 3), dict(notes))
    _write_stamp(folder, stamp)
    return stamp

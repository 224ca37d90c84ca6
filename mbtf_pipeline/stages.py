"""Stages that run only when something they depend on has changed, decided by content alone.

A stage's key is a hash over its resolved configuration, the digests of its input files and of the outputs of
the stages it needs, and the version of its scheme. When it has run, a stamp with the key and the digest of
every file it wrote is written last, atomically: a stage without a stamp has not run. A stage is up to date
while its key is the stamp's and its files are as the stamp says; dates and names of folders decide nothing.
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
# Part of every key: raise it when a stage makes something else from the same inputs.
STAGE_SCHEMA = 1
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
    config : its resolved options, plain data
    inputs : digests of files from outside the run, by role
    outputs : lists the files it has written, when it has run
    run : does the work, told why, and returns notes for the stamp
    """

    name: str
    needs: tuple[str, ...]
    config: Mapping[str, Any]
    inputs: Mapping[str, str]
    outputs: Callable[[], Sequence[Path]]
    run: Callable[[Decision], Mapping[str, Any]]


@dataclass(frozen=True)
class Stamp:
    """What a finished stage left behind.

    Attributes
    ----------
    key : the hash it ran with; depends : what that hash covers
    outputs : file, relative to the run's folder → SHA-256
    seconds : wall clock of the run that made them
    notes : what the stage itself says about its work
    """

    stage: str
    key: str
    depends: dict[str, Any]
    outputs: dict[str, str]
    seconds: float
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def outputs_hash(self) -> str:
        """One digest of everything the stage wrote."""
        return data_sha256(self.outputs)


@dataclass(frozen=True)
class Decision:
    """Whether a stage must run.

    Attributes
    ----------
    reason : why it runs; empty where it is up to date
    damaged : files of the last run that are missing or have changed since, where that is the reason
    """

    reason: str
    damaged: tuple[Path, ...] = ()

    @property
    def runs(self) -> bool:
        """Whether the stage must run."""
        return bool(self.reason)

    @property
    def forced(self) -> bool:
        """Whether it runs because it was asked to, so that nothing of its last run may be kept."""
        return self.reason == FORCED


def stamp_path(folder: Path, stage: str) -> Path:
    """Where a stage's stamp lies in a run's folder."""
    return folder / STAMPS / f"{stage.replace(' ', '-')}.json"


def read_stamp(folder: Path, stage: str) -> Stamp | None:
    """A stage's stamp; None where there is none that this version understands."""
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
    plain: dict[str, Any] = json.loads(json.dumps(data))  # as it will be read back: tuples become lists
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
    return f"what it reads has changed: {', '.join(names)}" if names else "stage has another version"


def decide(folder: Path, stage: Stage, upstream: Mapping[str, str], fresh: Sequence[str] = ()) -> Decision:
    """Whether a stage of the run in `folder` must run.

    Parameters
    ----------
    upstream : stage it needs → digest of what that one wrote
    fresh : stages that have just run; whatever needs one of them runs too
    """
    stamp = read_stamp(folder, stage.name)
    if stamp is None:
        return Decision(NOT_RUN)
    depends = _depends(stage, upstream)
    if stamp.key != _key(stage, depends):
        return Decision(_what_changed(stamp.depends, depends))
    damaged = tuple(
        folder / name
        for name, expected in stamp.outputs.items()
        if not (folder / name).is_file() or file_sha256(folder / name) != expected
    )
    if damaged:
        what = "is missing" if not damaged[0].exists() else "has changed"
        return Decision(f"{damaged[0].relative_to(folder)} {what}", damaged)
    if after := [n for n in stage.needs if n in fresh]:
        return Decision(f"follows {after[0]}")
    return Decision("")


@dataclass(frozen=True)
class Outcome:
    """What became of one stage in this run: its stamp, whether it ran, and why."""

    stamp: Stamp
    ran: bool
    reason: str


def run_stages(
    folder: Path,
    stages: Sequence[Stage],
    *,
    force: bool = False,
    tell: Callable[[str, Decision, Stamp | None], None] | None = None,
) -> dict[str, Outcome]:
    """Run what must run, in the given order (a stage after those it needs).

    Parameters
    ----------
    force : run every stage
    tell : called with (stage, decision, None) before each stage, and with its stamp after it
    """
    done: dict[str, Outcome] = {}
    for stage in stages:
        upstream = {name: done[name].stamp.outputs_hash for name in stage.needs}
        fresh = [name for name, outcome in done.items() if outcome.ran]
        decision = Decision(FORCED) if force else decide(folder, stage, upstream, fresh)
        if tell is not None:
            tell(stage.name, decision, None)
        stamp = read_stamp(folder, stage.name)
        if decision.runs or stamp is None:
            stamp = _run(folder, stage, upstream, decision)
        done[stage.name] = Outcome(stamp, decision.runs, decision.reason)
        if tell is not None:
            tell(stage.name, decision, stamp)
    return done


def run_again(folder: Path, stage: Stage) -> Stamp:
    """Run one stage whatever its state; the stages it needs have finished.

    Raises
    ------
    InputError : one of them has not
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
    # From here to the new stamp the stage counts as not run, whatever happens.
    stamp_path(folder, stage.name).unlink(missing_ok=True)
    start = time.perf_counter()
    notes = stage.run(decision)
    seconds = time.perf_counter() - start
    depends = _depends(stage, upstream)
    outputs = {path.relative_to(folder).as_posix(): file_sha256(path) for path in sorted(stage.outputs())}
    stamp = Stamp(stage.name, _key(stage, depends), depends, outputs, round(seconds, 3), dict(notes))
    _write_stamp(folder, stamp)
    return stamp

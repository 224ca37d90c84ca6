"""Stages that run only if their inputs have changed, decided by content and not by date.

The key of a stage is a hash of its resolved configuration, the digests of its input files, the digests of
the outputs of the stages it needs, and a schema version. After a stage has run, a stamp is written
atomically. It holds the key and the digest of every output file. A stage is up to date if its key equals
that of its stamp and its files match their digests; a stage without a stamp has not run.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import data_sha256, file_sha256, read_json, write_json

STAMP_FORMAT = "mbtf-stage"
# Part of every key; raised when a stage produces different outputs from the same inputs.
STAGE_SCHEMA = 3
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
    run : does the work; may return the seconds that it took in all, earlier processes included
    remote : other machines do the work, so that consecutive stages of this kind run at the same time
    """

    name: str
    needs: tuple[str, ...]
    config: Mapping[str, Any]
    inputs: Mapping[str, str]
    outputs: Callable[[], Sequence[Path]]
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
    from mbtf_core.config.settings import differences

    if changes := differences(old["config"], new["config"]):
        more = f" and {len(changes) - 3} more" if len(changes) > 3 else ""
        return f"options changed: {'; '.join(changes[:3])}{more}"
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


@dataclass(frozen=True)
class StageResult:
    """Result of one stage in this run: its stamp, whether it ran, and why."""

    stamp: Stamp
    ran: bool
    reason: str


Notify = Callable[[str, Decision, Stamp | None], None]


def run_stages(
    folder: Path,
    stages: Sequence[Stage],
    *,
    force: bool = False,
    notify: Notify | None = None,
) -> dict[str, StageResult]:
    """Run all stages that are not up to date, in the given order.

    Parameters
    ----------
    force : run every stage
    notify : called before each stage with (stage, decision, None), and after it with its stamp
    """
    done: dict[str, StageResult] = {}
    for remote, group in itertools.groupby(stages, lambda stage: stage.remote):
        together = list(group)
        if not remote:
            for stage in together:
                decision = _decide(folder, stage, done, force, notify)
                done[stage.name] = _finish(folder, stage, decision, notify)
            continue
        # Decided before any runs; none needs another.
        decisions = [_decide(folder, stage, done, force, notify) for stage in together]
        pool = ThreadPoolExecutor(len(together), "stages")
        try:
            running = {
                pool.submit(_finish, folder, stage, decision, notify): stage.name
                for stage, decision in zip(together, decisions, strict=True)
            }
            results = {running[future]: future for future in as_completed(running)}
        finally:
            # An interruption does not wait for what other machines do.
            pool.shutdown(wait=False, cancel_futures=True)
        # In the stages' order; the first that failed raises, when all have ended.
        done |= {stage.name: results[stage.name].result() for stage in together}
    return done


def _decide(
    folder: Path, stage: Stage, done: Mapping[str, StageResult], force: bool, notify: Notify | None
) -> Decision:
    fresh = [name for name, result in done.items() if result.ran]
    decision = Decision(FORCED) if force else decide(folder, stage, fresh)
    if notify is not None:
        notify(stage.name, decision, None)
    return decision


def _finish(folder: Path, stage: Stage, decision: Decision, notify: Notify | None) -> StageResult:
    """Run a stage if it must run."""
    stamp = read_stamp(folder, stage.name)
    if decision.runs or stamp is None:
        stamp = _run(folder, stage, decision)
    if notify is not None:
        notify(stage.name, decision, stamp)
    return StageResult(stamp, decision.runs, decision.reason)


def run_again(folder: Path, stage: Stage) -> None:
    """Run one stage regardless of its state.

    Raises
    ------
    InputError : a stage that it needs has not finished
    """
    for name in stage.needs:
        if read_stamp(folder, name) is None:
            raise InputError(
                f"stage '{name}' is not finished", where=folder, hint="run the recipe again: it resumes"
            )
    _run(folder, stage, Decision(FORCED))


def _run(folder: Path, stage: Stage, decision: Decision) -> Stamp:
    path = stamp_path(folder, stage.name)
    # Without a stamp, an interrupted stage counts as not run.
    path.unlink(missing_ok=True)
    start = time.perf_counter()
    whole = stage.run(decision) or 0.0
    seconds = max(whole, time.perf_counter() - start)
    depends, key = _depends(folder, stage)
    outputs = {file.relative_to(folder).as_posix(): file_sha256(file) for file in sorted(stage.outputs())}
    stamp = Stamp(stage.name, key, depends, outputs, round(seconds, 3))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"format": STAMP_FORMAT, "schema": STAGE_SCHEMA, **vars(stamp)})
    return stamp

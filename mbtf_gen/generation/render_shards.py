"""Renders shards to files: a task is a shard, done when its sidecar is there.

A lock claims it. In this process, threads sample queries ahead and write shards behind.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from mbtf_core.data.documents import finished_record, plan_digest, sidecar, upload_waiting
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.schema import MANIFEST_NAME, Queries, ShardEntry
from mbtf_core.data.shard_files import write_shard
from mbtf_core.errors import InputError, LockedError, PartialError
from mbtf_core.files.atomic import Stored
from mbtf_core.locks import lock_owner, take_lock
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item, Result
from mbtf_gen.generation.folder import read_run_plan
from mbtf_gen.generation.summary import ShardStatistics, refuse_nonfinite
from mbtf_gen.job import Job, most_paths, planned_paths, split_spp, split_target
from mbtf_gen.planning.adaptive import estimate_shard
from mbtf_gen.planning.run_plan import RunPlan
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream

# Called with the paths so far, a note, and the paths expected in all (None: not known yet).
ProgressCallback = Callable[[float, str, float | None], None]


# Failures in a row of workers after which the other shards are not tried: the disk is full.
_FAILURES = 8


class ExpectedPaths:
    """Paths of shards to come. A target error or an allocation changes the planned number; it is corrected by
    the ratio of traced and planned paths of the shards so far, by split."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._planned: Counter[str] = Counter()
        self._traced: Counter[str] = Counter()

    def add(self, entry: ShardEntry, paths: int) -> None:
        self._planned[entry.split] += planned_paths(self._job, [entry])
        self._traced[entry.split] += paths

    def paths(self, entries: Iterable[ShardEntry]) -> float | None:
        """None where a target error decides, and no shard is done."""
        total = 0.0
        for entry in entries:
            ratio = 1.0
            if done := self._planned[entry.split]:
                ratio = self._traced[entry.split] / done
            elif split_target(self._job.config, entry.split) is not None:
                return None
            total += ratio * planned_paths(self._job, [entry])
        return round(total)


def progress_of(
    paths: int, seconds: float, totals: ShardStatistics, left: float | None, where: str = ""
) -> tuple[float, str, float | None]:
    """Arguments of a :data:`ProgressCallback`: `paths` traced in `seconds`, `left` to come, by whom."""
    noise = totals.relative_error() if totals.train else None
    error = "" if noise is None else f", noise {noise:.2%}"
    note = f"{paths / max(seconds, 1e-9) / 1e6:.2f} M paths/s{where}{error}"
    return paths, note, None if left is None else paths + left


@dataclass
class RenderResult:
    """Result of :func:`render_shards`.

    Attributes
    ----------
    paths : traced; shards : files that were rendered
    seconds : duration since the start of the run
    writing : processor seconds of writing and digesting, parallel to the rendering
    waiting : seconds that this process waited for the writing
    """

    paths: int = 0
    shards: list[str] = field(default_factory=list)
    seconds: float = 0.0
    writing: float = 0.0
    waiting: float = 0.0


class ShardRun:
    """What the shards of a run share, built once in each process.

    Pickled, it is its job, its folder and the digest of its plan: a worker reads the plan from the manifest
    that it sees, and writes into the folder itself.

    Parameters
    ----------
    job : Job
    folder : DataFolder
        The data set.
    plan : RunPlan
        That of its manifest.
    received : bool
        Another process sent it, which gives a shard to one worker alone.
    """

    def __init__(self, job: Job, folder: DataFolder, plan: RunPlan, received: bool = False) -> None:
        self.job, self.folder, self.plan, self.received = job, folder, plan, received
        self.digest = plan_digest(plan.to_manifest())

    def __reduce__(self) -> tuple[Any, ...]:
        local = self.folder.local
        folder = str(self.folder) if local is None else os.path.abspath(local)
        return _received_run, (self.job, folder, self.digest)

    @cached_property
    def estimator(self) -> Any:
        """Built where a shard is to be rendered."""
        return build_estimator(self.job, self.plan.effects)

    def finished(self, entry: ShardEntry) -> dict[str, Any] | None:
        """Sidecar of a finished shard."""
        record = finished_record(self.folder, entry, self.job.config_hash)
        if record is None or not self.received or self.folder.local is not None:
            return record
        # The store is listed again: the shard may have been removed since this worker saw it there.
        self.folder.refresh()
        return finished_record(self.folder, entry, self.job.config_hash)


_received: ShardRun | None = None


def _received_run(job: Job, folder: str, digest: str) -> ShardRun:
    """The run of another process, kept for its next shard.

    Raises
    ------
    InputError : this machine does not see the folder, or its manifest has another plan
    """
    global _received
    kept = _received is not None and _received.job is job and _received.digest == digest
    if _received is None or not kept or str(_received.folder) != folder:
        found = DataFolder.open(folder)
        if not found.has(MANIFEST_NAME):
            raise InputError("this machine does not see the data set", where=folder)
        run = ShardRun(job, found, read_run_plan(found), received=True)
        if run.digest != digest:
            raise InputError("the manifest has another plan on this machine", where=folder)
        _received = run
    return _received


def render_shard(run: ShardRun, entry: ShardEntry) -> Generator[None, None, dict[str, Any]]:
    """Render one shard into its folder, unless it is finished; a task in three parts.

    Parameters
    ----------
    run : ShardRun
    entry : ShardEntry
        The shard.

    Returns
    -------
    dict
        ``record`` (the sidecar), ``rendered`` (whether this call rendered it), ``writing`` (processor seconds
        of writing and digesting).

    Raises
    ------
    LockedError
        Another process writes it.
    PartialError
        The disk is full, or the store cannot be reached.
    """
    if (record := run.finished(entry)) is not None:
        return {"record": record, "rendered": False, "writing": 0.0}
    lock = take_lock(run.folder.workspace / entry.file)
    if lock is None:
        raise LockedError("is being written by another process", where=run.folder.at(entry.file))
    try:
        # Another process may have finished it since.
        if (record := run.finished(entry)) is not None:
            return {"record": record, "rendered": False, "writing": 0.0}
        queries = run.job.query_plan.draw(entry.split, entry.index, entry.rows)
        yield
        began = time.perf_counter()
        estimates = estimate_queries(run.job, run.plan, run.estimator, entry, queries)
        seconds = time.perf_counter() - began
        yield
        began = time.thread_time()
        record = store_shard(run.job, run.folder, run.plan, entry, queries, estimates, seconds)
        return {"record": record, "rendered": True, "writing": time.thread_time() - began}
    finally:
        lock.release()


def render_shards(
    job: Job,
    folder: DataFolder,
    entries: Iterable[ShardEntry],
    plan: RunPlan,
    runner: Runner,
    *,
    start: float | None = None,
    progress: ProgressCallback | None = None,
) -> RenderResult:
    """Render those of the shards that are not finished.

    Parameters
    ----------
    runner : maps :func:`render_shard` over the shards
    start : when the run began, by ``time.perf_counter``; now by default. Seconds and paths per second count
        from it
    progress : called once per shard

    Raises
    ------
    InputError : a worker cannot read the material or the folder
    PartialError : other processes render some of them, shards failed, the disk is full, the store or the
        workers cannot be reached, or there are too many non-finite samples; finished shards are kept
    """
    start = time.perf_counter() if start is None else start
    pending = {entry.file: entry for entry in entries}
    result, totals, expected = RenderResult(), ShardStatistics(), ExpectedPaths(job)
    limit = most_paths(job)
    run = ShardRun(job, folder, plan)
    # Leftovers of killed runs take disk space.
    folder.remove_leftovers()
    upload_waiting(folder, job.shards, job.config_hash, run.digest)
    items = [Item(file, {"run": run, "entry": entry}) for file, entry in pending.items()]
    where = "" if runner.here else f" on {runner.workers} workers"
    busy, failed, row = list[str](), list[Result](), 0
    with closing(runner.map(render_shard, items)) as results:
        for done in results:
            if done.locked:
                busy.append(done.name)
            elif done.error:
                failed.append(done)
                row += 1
                if row >= (1 if runner.here else max(_FAILURES, 2 * runner.workers)):
                    break
            else:
                row, entry = 0, pending.pop(done.name)
                totals.add(done.value["record"])
                refuse_nonfinite(totals, limit, folder)
                result.writing += done.value["writing"]
                result.waiting = done.waited
                if done.value["rendered"]:
                    paths = done.value["record"]["paths"]
                    result.paths += paths
                    result.shards.append(entry.file)
                    expected.add(entry, paths)
            if progress is not None:
                seconds, left = time.perf_counter() - start, expected.paths(pending.values())
                progress(*progress_of(result.paths, seconds, totals, left, where))
    result.seconds = time.perf_counter() - start
    if failed and runner.here:
        raise PartialError(failed[0].error, hint=failed[0].hint)
    if failed:
        first = failed[0]
        raise PartialError(
            f"{len(failed)} shard(s) failed, {len(pending)} are left; first {first.name}: {first.error} "
            f"(on {first.worker})",
            where=folder,
            hint=first.hint or "the same command resumes",
        )
    if busy:
        owner = lock_owner(folder.workspace / busy[0])
        who = "" if owner is None else f" ({owner})"
        raise PartialError(
            f"{len(busy)} shard(s) are being written by another process, first {busy[0]}{who}",
            where=folder,
            hint="wait for it, then run the same command again",
        )
    return result


def estimate_queries(
    job: Job, plan: RunPlan, estimator: Any, entry: ShardEntry, queries: Queries
) -> Estimates:
    """Both halves of the queries of a shard; they depend on seed, split and index, not on the process."""
    return estimate_shard(
        estimator,
        queries.flat(),
        split_spp(job.config, entry.split),
        split_target(job.config, entry.split),
        Stream(job.config.seed, entry.split, entry.index),
        plan.allocation,
    )


def store_shard(
    job: Job,
    folder: DataFolder,
    plan: RunPlan,
    entry: ShardEntry,
    queries: Queries,
    estimates: Estimates,
    seconds: float,
) -> dict[str, Any]:
    """Write a rendered shard and its sidecar; returns the sidecar. Errors are those of
    :meth:`~mbtf_core.data.folder.DataFolder.write_shard`."""
    lead, through = queries.lead, estimates.transmittance
    a, b = estimates.value_a, estimates.value_b
    planned = split_spp(job.config, entry.split)
    spp = planned if estimates.spp is None else estimates.spp.reshape(lead)
    arrays = {
        **vars(queries),
        "value_a": a.reshape(*lead, 3),
        "value_b": b.reshape(*lead, 3),
        "spp": np.broadcast_to(np.asarray(spp, np.float32), lead).copy(),
        **({} if through is None else {"transmittance": through.reshape(lead)}),
    }

    def record(stored: Stored) -> dict[str, Any]:
        return sidecar(
            entry,
            stored,
            config_hash=job.config_hash,
            plan=plan_digest(plan.to_manifest()),
            seed=job.config.seed,
            spp=planned,
            queries=len(a),
            paths=estimates.paths,
            seconds=round(seconds, 4),
            quarantined=_quarantined(estimates),
            target=None if estimates.target is None else asdict(estimates.target),
            mean_value=(0.5 * sum(half.mean(axis=0, dtype=np.float64) for half in (a, b))).tolist(),
            mean_variance=(0.25 * np.square((a - b).astype(np.float64)).mean(axis=0)).tolist(),
        )

    return folder.write_shard(entry.file, lambda path: write_shard(path, arrays), record)


def _quarantined(estimates: Estimates) -> dict[str, Any]:
    """A sidecar's record of samples that are not stored."""
    return {
        "nonfinite_samples": estimates.nonfinite,
        "lost_rays": estimates.lost,
        "capped_rays": estimates.capped,
        "nonfinite_at": [asdict(bad) for bad in estimates.bad_samples],
    }

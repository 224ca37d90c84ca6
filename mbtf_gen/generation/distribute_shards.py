"""Renders shards on the workers of a cluster: a task is a shard, done when its sidecar is there.

Workers write into the data set's folder themselves, with the same locks and checks as a command of its own,
so that the scheduler carries names and figures alone. A worker keeps material and scene for its next shard.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

from mbtf_core.cluster.engine import Cluster
from mbtf_core.cluster.task import Task
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.manifest import plan_digest
from mbtf_core.data.schema import MANIFEST_NAME, ShardEntry
from mbtf_core.data.sidecar import finished_record, upload_waiting
from mbtf_core.errors import InputError, LockedError, PartialError
from mbtf_core.locks import take_lock
from mbtf_gen.generation.folder import read_run_plan
from mbtf_gen.generation.render_shards import (
    ExpectedPaths,
    ProgressCallback,
    RenderResult,
    estimate_queries,
    progress_of,
    store_shard,
)
from mbtf_gen.generation.summary import ShardStatistics, refuse_nonfinite
from mbtf_gen.job import Job, most_paths
from mbtf_gen.planning.run_plan import RunPlan
from mbtf_gen.planning.simulation import build_estimator

# Failures in a row after which the other shards are not tried: the disk is full.
_FAILURES = 8
_THIS = "mbtf_gen.generation.distribute_shards:render_shard"


def distribute_shards(
    job: Job,
    folder: DataFolder,
    entries: Iterable[ShardEntry],
    plan: RunPlan,
    cluster: Cluster,
    *,
    start: float | None = None,
    progress: ProgressCallback | None = None,
) -> RenderResult:
    """Render those of the shards that are not finished on a cluster.

    Parameters
    ----------
    start, progress : as for :func:`~mbtf_gen.generation.render_shards.render_shards`

    Raises
    ------
    InputError : a worker cannot read the material or the folder
    PartialError : shards failed, the cluster is lost, the disk is full, or there are too many non-finite
        samples; finished shards are kept
    """
    start = time.perf_counter() if start is None else start
    folder.remove_leftovers()
    upload_waiting(folder, job.shards, job.config_hash, plan_digest(plan.to_manifest()))
    pending = {entry.file: entry for entry in entries}
    result, totals, expected = RenderResult(), ShardStatistics(), ExpectedPaths(job)
    limit = most_paths(job)
    shared = {
        "config": job.portable(),
        "folder": str(folder) if folder.local is None else os.path.abspath(folder.local),
        "config_hash": job.config_hash,
        "plan": plan_digest(plan.to_manifest()),
    }
    failed: dict[str, str] = {}
    row = 0
    tasks = [Task(file, _THIS, {**shared, "file": file}) for file in pending]
    with contextlib.closing(cluster.run(tasks)) as results:
        for done in results:
            if done.error:
                failed[done.task.name] = f"{done.error} (on {done.worker})" if done.worker else done.error
                row += 1
                if row >= max(_FAILURES, 2 * cluster.workers):
                    break
                continue
            row = 0
            entry = pending.pop(done.task.name)
            totals.add(done.value["record"])
            refuse_nonfinite(totals, limit, folder)
            if done.value["rendered"]:
                paths = done.value["record"]["paths"]
                result.paths += paths
                result.shards.append(entry.file)
                expected.add(entry, paths)
            if progress is not None:
                seconds, left = time.perf_counter() - start, expected.paths(pending.values())
                where = f" on {cluster.workers} workers"
                progress(*progress_of(result.paths, seconds, totals, left, where))
    result.seconds = time.perf_counter() - start
    if failed:
        name, why = next(iter(failed.items()))
        raise PartialError(
            f"{len(failed)} shard(s) failed, {len(pending)} are left; first {name}: {why}",
            where=folder,
            hint="the same command goes on",
        )
    return result


def render_shard(
    config: dict[str, Any], folder: str, config_hash: str, plan: str, file: str
) -> dict[str, Any]:
    """Render one shard into its folder, unless it is finished; runs on a worker.

    Parameters
    ----------
    config : dict
        :meth:`Job.portable <mbtf_gen.job.Job.portable>`.
    folder : str
        The data set, whose manifest holds the run's plan.
    config_hash, plan : str
        Hash of the configuration, and digest of the plan, that the manifest must have.
    file : str
        Name of the shard.

    Returns
    -------
    dict
        ``record`` (the sidecar) and ``rendered`` (whether this call rendered it).

    Raises
    ------
    InputError
        This machine does not see the folder, or its files differ.
    PartialError
        The folder cannot be written, or another process of this machine renders the shard.
    """
    into = _folder_of(folder, config_hash, plan)
    if not into.has(MANIFEST_NAME):
        raise InputError("this machine does not see the data set", where=into)
    run = _run_of(json.dumps(config), into, config_hash, plan)
    entry = run.entries[file]
    if (record := _record_now(into, entry, config_hash)) is not None:
        return {"record": record, "rendered": False}
    lock = take_lock(into.workspace / file)
    if lock is None:
        raise LockedError("is being written by another process", where=into.at(file))
    try:
        # Another process may have finished it since.
        if (record := _record_now(into, entry, config_hash)) is not None:
            return {"record": record, "rendered": False}
        estimator = run.estimator
        began = time.perf_counter()
        queries = run.job.query_plan.draw(entry.split, entry.index, entry.rows)
        estimates = estimate_queries(run.job, run.plan, estimator, entry, queries)
        seconds = time.perf_counter() - began
        record = store_shard(run.job, into, run.plan, entry, queries, estimates, seconds)
        return {"record": record, "rendered": True}
    finally:
        lock.release()


def _record_now(folder: DataFolder, entry: ShardEntry, config_hash: str) -> dict[str, Any] | None:
    """Sidecar of a finished shard. A store is listed again: the shard may have been removed since this worker
    saw it there."""
    record = finished_record(folder, entry, config_hash)
    if record is None or folder.local is not None:
        return record
    folder.refresh()
    return finished_record(folder, entry, config_hash)


@dataclass(frozen=True)
class _Run:
    """What the shards of a data set share."""

    job: Job
    plan: RunPlan

    @cached_property
    def entries(self) -> dict[str, ShardEntry]:
        """Shards by file."""
        return {entry.file: entry for entry in self.job.shards}

    @cached_property
    def estimator(self) -> Any:
        """Built where a shard is to be rendered."""
        return build_estimator(self.job, self.plan.effects)


@lru_cache(maxsize=1)
def _folder_of(folder: str, config_hash: str, plan: str) -> DataFolder:
    """The folder of a data set; one in a store is not listed again for each shard."""
    return DataFolder.open(folder)


@lru_cache(maxsize=1)
def _run_of(config: str, folder: DataFolder, config_hash: str, plan: str) -> _Run:
    """The run of a data set, kept for its next shard."""
    job = Job.of_portable(config, config_hash)
    found = read_run_plan(folder)
    if plan_digest(found.to_manifest()) != plan:
        raise InputError("the manifest has another plan on this machine", where=folder)
    return _Run(job, found)
